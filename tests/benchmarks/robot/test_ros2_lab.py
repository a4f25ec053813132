"""The simulated lab says by its own code what the product says by its own: they must agree on every interface."""

from pathlib import Path

import pytest

from benchmarks.robot.ros2_lab.camera import FRAME
from benchmarks.robot.ros2_lab.controllers import ARM, FINGER, FOLLOW, GRIP, GRIPPER
from benchmarks.robot.ros2_lab.wire import Interfaces
from runner.graph.reading import load_graph
from stages.devices.ros2.settings import Frames
from stages.devices.ros2.types import Types

ROOT = Path(__file__).parents[3]
ACTION_PARTS = ("SendGoal", "GetResult", "FeedbackMessage")
NAMES = [
    *(f"{action}_{part}" for action in (FOLLOW, GRIP) for part in ACTION_PARTS),
    "action_msgs/srv/CancelGoal",
    "std_srvs/srv/Trigger",
    "sensor_msgs/msg/JointState",
    "sensor_msgs/msg/Image",
    "tf2_msgs/msg/TFMessage",
]


@pytest.fixture(scope="module")
def theirs() -> Interfaces:
    return Interfaces()


@pytest.mark.parametrize("name", NAMES)
def test_hashes_agree(name: str, theirs: Interfaces) -> None:
    assert theirs.store.hash_rihs01(name) == Types.of("jazzy").hash(name)


def test_messages_agree(theirs: Interfaces) -> None:
    ours = Types.of("jazzy")
    point = {"positions": [0.1, 0.2], "velocities": [0.0, 1.0], "time_from_start": {"sec": 1, "nanosec": 5}}
    trajectory = {"joint_names": ["a", "b"], "points": [point]}
    bytes_of = theirs.store.serialize_cdr
    made = theirs(f"{FOLLOW}_Goal", trajectory=theirs("trajectory_msgs/msg/JointTrajectory", **trajectory))
    goal = ours.decode(bytes(bytes_of(made, f"{FOLLOW}_Goal")), f"{FOLLOW}_Goal")
    assert goal.trajectory.joint_names == ["a", "b"]
    assert goal.trajectory.points[0].positions.tolist() == [0.1, 0.2]
    assert goal.trajectory.points[0].time_from_start.nanosec == 5


def test_the_graph_of_a_lab_finds_this_one() -> None:
    controllers = load_graph(ROOT / "graphs" / "arm.yaml").nodes["arm"].config.controllers
    assert (controllers.trajectory, controllers.gripper, controllers.gripper_joint) == (ARM, GRIPPER, FINGER)
    assert Frames().camera == FRAME
