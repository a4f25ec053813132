"""Pictures as pages and what is kept for them have them: compressed."""

from __future__ import annotations

import io

from PIL import Image

from runner.page.story import Photo

QUALITY = 88
"""Of JPEG."""


def jpeg(photo: Photo) -> bytes:
    """A picture as a file."""
    file = io.BytesIO()
    Image.fromarray(photo.rgb).save(file, "JPEG", quality=QUALITY)
    return file.getvalue()
