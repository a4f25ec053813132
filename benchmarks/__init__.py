"""Commands that measure something, in folders by topic: each is ``python -m benchmarks.NAME``, whatever its folder."""

from pathlib import Path

__path__.extend(str(folder) for folder in sorted(Path(__file__).parent.iterdir()) if folder.is_dir())
