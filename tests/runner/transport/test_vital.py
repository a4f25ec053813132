"""A process without one of its vital threads is of no use, and ends."""

import subprocess
import sys
from pathlib import Path

FAILS = """
from runner.transport.vital import vital_thread

def work():
    raise MemoryError

thread = vital_thread("fails", work)
thread.start()
thread.join()
"""


def test_a_vital_thread_that_fails_ends_its_process_also_where_the_disk_under_the_log_is_full():
    with Path("/dev/full").open("w") as full:
        assert subprocess.run([sys.executable, "-c", FAILS], check=False, stderr=full).returncode == 1
