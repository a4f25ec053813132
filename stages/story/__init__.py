"""What a person who does not program is told of a run: in sentences, outlines, cards and buttons."""

from stages.story.story import Story

__all__ = ["Story"]
