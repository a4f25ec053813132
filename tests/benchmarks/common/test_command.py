"""What all commands share."""

import pytest

from benchmarks.common.command import REFUSED, command
from runner.contract import Refused


def test_a_refused_input_is_said_and_gives_its_exit_code(capsys: pytest.CaptureFixture[str]) -> None:
    @command
    def main() -> int:
        raise Refused("--processes 0: must be at least 1")

    assert main() == REFUSED == 2
    assert capsys.readouterr().err == "--processes 0: must be at least 1\n"


def test_a_command_that_ends_keeps_its_exit_code() -> None:
    assert command(lambda: 1)() == 1
