"""Messages read and written by the genuine ROS 2 Kilted, which is on PyPI for Fast DDS: an oracle for bytes and hashes.

Skipped where it is not in ``build/ros2``: ``docs/ros2.md`` says how to put it there.
"""

import json
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.interfaces import Nodetype

from stages.devices.ros2.types import Types
from tests.stages.devices.ros2.test_wire import assert_equal_but_padding

ROOT = Path(__file__).parents[4]
GENUINE = ROOT / "build" / "ros2"
PYTHON = GENUINE / "bin" / "python"
pytestmark = pytest.mark.skipif(not PYTHON.exists(), reason=f"no genuine ROS 2 in {GENUINE}")
TYPES = Types.of("kilted")
NAMES = (
    "action_msgs/msg/GoalStatusArray",
    "action_msgs/srv/CancelGoal_Request",
    "action_msgs/srv/CancelGoal_Response",
    "geometry_msgs/msg/TransformStamped",
    "sensor_msgs/msg/CameraInfo",
    "sensor_msgs/msg/CompressedImage",
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/JointState",
    "sensor_msgs/msg/PointCloud2",
    "std_msgs/msg/String",
    "std_srvs/srv/Trigger_Request",
    "std_srvs/srv/Trigger_Response",
    "trajectory_msgs/msg/JointTrajectory",
    "visualization_msgs/msg/MarkerArray",
)
ORACLE = """
import functools, importlib, json, sys
from rclpy.serialization import deserialize_message, serialize_message

def plain(value):
    if hasattr(value, "get_fields_and_field_types"):
        return {field: plain(getattr(value, field)) for field in value.get_fields_and_field_types()}
    if hasattr(value, "tolist"):
        return value.tolist()
    return value if isinstance(value, (str, bool, int, float)) else [plain(one) for one in value]

answers = {}
for name, data in json.load(sys.stdin).items():
    package, kind, type = name.split("/")
    kind = functools.reduce(getattr, type.split("_"), importlib.import_module(f"{package}.{kind}"))
    message = deserialize_message(bytes.fromhex(data), kind)
    answers[name] = plain(message), serialize_message(message).hex()
json.dump(answers, sys.stdout)
"""


def test_messages_are_read_and_written_as_genuine_ones() -> None:
    rng = np.random.default_rng(0)
    ours = {name: message(name, rng) for name in NAMES}
    said = json.dumps({name: TYPES.encode(one).hex() for name, one in ours.items()})
    done = subprocess.run([PYTHON, "-c", ORACLE], input=said, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    answers = json.loads(done.stdout)
    for name, one in ours.items():
        fields, data = answers[name]
        assert fields == plain(one), name
        assert_equal_but_padding(name, bytes.fromhex(data))
        assert plain(TYPES.decode(bytes.fromhex(data), name)) == fields


def test_hashes_are_those_that_genuine_packages_state() -> None:
    files = [json.loads(path.read_text()) for path in (GENUINE / "share").glob("*/*/*.json")]
    stated = {one["type_name"]: one["hash_string"] for file in files for one in file.get("type_hashes", ())}
    known = {name: hash for name, hash in stated.items() if name in TYPES}
    assert set(NAMES) <= set(known) and len(known) > 100
    assert {name: TYPES.hash(name) for name in known} == known


def message(name: str, rng: np.random.Generator) -> Any:
    """One with something in every field."""
    _, fields = TYPES._store.fielddefs[name]  # pyright: ignore[reportPrivateUsage]
    return TYPES.new(name, **{field: filled(kind, rng) for field, kind in fields})


def filled(kind: Any, rng: np.random.Generator) -> Any:
    node, inner = kind
    if node is Nodetype.NAME:
        return message(inner, rng)
    if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        element, count = inner
        return [filled(element, rng) for _ in range(count if node is Nodetype.ARRAY else 3)]
    if inner[0] == "string":
        return "".join(rng.choice(list("a/é_"), int(rng.integers(0, 6))))
    if inner[0] == "bool":
        return bool(rng.integers(2))
    return float(np.float32(rng.normal())) if inner[0].startswith("float") else int(rng.integers(0, 100))


def plain(value: Any) -> Any:
    """As JSON has it."""
    if hasattr(value, "__msgtype__"):
        names = [name for name, _ in TYPES._store.fielddefs[value.__msgtype__][1]]  # pyright: ignore[reportPrivateUsage]
        return {name: plain(getattr(value, name)) for name in names if name != "structure_needs_at_least_one_member"}
    if isinstance(value, np.ndarray):
        return value.tolist()
    return [plain(one) for one in value] if isinstance(value, list) else value
