"""How the program ``runner`` ends."""

import os
import subprocess
import sys
from pathlib import Path

from runner.process.forks import clean_environment
from tests.runner.common.runs import TOYS

BUSY = """
import atexit, threading, time
import zenoh
from tests.runner.common.toy_views import ToyViews as Views

config = zenoh.Config()
config.insert_json5("scouting/multicast/enabled", "false")
session = zenoh.open(config)

def publish():
    while True:
        session.put("busy", bytes(1000))

threading.Thread(target=publish, daemon=True).start()
time.sleep(0.3)
atexit.register(print, "the last words")
"""
"""A module with a thread that is in a call of Zenoh nearly always."""


def test_a_thread_that_is_in_a_call_of_zenoh_changes_no_exit_status(tmp_path: Path):
    (tmp_path / "busy.py").write_text(BUSY)
    command = [sys.executable, "-m", "runner.cli", "check", str(TOYS), "--set", "view=busy:Views"]
    command += ["--set", "sink.path=out.txt"]
    done = subprocess.run(
        command, cwd=tmp_path, env=clean_environment(), capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.endswith("the last words\n")


def test_what_cannot_be_written_is_no_success(tmp_path: Path):
    command = [sys.executable, "-m", "runner.cli", "check", "--help"]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            command, cwd=tmp_path, env=environment, stdout=full, stderr=subprocess.PIPE, timeout=60, check=False
        )
    assert (done.returncode, done.stderr) == (1, b"[Errno 28] No space left on device\n")
