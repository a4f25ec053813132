"""Threads without which a process is of no use."""

import os
import sys
import threading
import traceback
from collections.abc import Callable


def vital_thread(name: str, work: Callable[[], None]) -> threading.Thread:
    """A thread that is not started yet. What it raises ends the process, with the traceback: without it, others would
    wait for a process that looks alive."""

    def run() -> None:
        try:
            work()
        except BaseException:
            try:
                traceback.print_exc()
                sys.stderr.flush()
            finally:  # also where the log is on a full disk
                os._exit(1)

    return threading.Thread(target=run, name=name, daemon=True)
