"""What all commands of this folder share."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import wraps

from runner.contract import Refused

REFUSED = 2
"""Exit code where an input is refused."""


def command(main: Callable[[], int]) -> Callable[[], int]:
    """A command's ``main`` that prints the reason and returns 2 where an input is refused."""

    @wraps(main)
    def run() -> int:
        try:
            return main()
        except Refused as refusal:
            print(refusal, file=sys.stderr)
            return REFUSED

    return run
