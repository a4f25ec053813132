"""A simulated world in which motions take as long as a real arm's, and lifts ten times as long, to stop one."""

import time
from collections.abc import Iterator

from runner.contract import Context
from stages.devices.servo import PIECE
from stages.messages import RobotCommand, RobotState
from stages.world import World


class SlowWorld(World):
    def on_robot_command(self, robot_command: RobotCommand, ctx: Context) -> Iterator[RobotState | None]:
        piece = 10 * PIECE if robot_command.label.startswith("lift ") else PIECE
        for state in super().on_robot_command(robot_command, ctx):
            if state is None:
                time.sleep(piece)
            yield state
