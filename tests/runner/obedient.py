"""A process that does what its task says, in Python."""

import sys


def main() -> int:
    """Executes stdin; the exit status is what that leaves in ``code``."""
    names = {"code": 0}
    exec(sys.stdin.read(), names)
    return names["code"]


if __name__ == "__main__":
    sys.exit(main())
