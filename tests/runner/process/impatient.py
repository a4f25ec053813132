"""A stage's process that does not wait for long for the word that another is dead."""

import sys

from runner.process import stage_process

if __name__ == "__main__":
    stage_process.CUT_OFF_SECONDS = 0.5
    sys.exit(stage_process.main())
