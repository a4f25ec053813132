"""``python -m runner.cli`` is ``runner``."""

from runner.cli.main import run

run()
