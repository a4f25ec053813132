"""What is said and written, against what genuine nodes were recorded to say: ROS 2 Kilted on rmw_zenoh_cpp 0.6.7."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runner.contract import Refused
from stages.devices.ros2.types import Types, matching
from stages.devices.ros2.wire import LATCHED, SENSOR, Attachment, Endpoint, Owner, Qos, full_name, ros_name

RECORDED = Path(__file__).parent / "recorded"
REFERENCE = json.loads((RECORDED / "reference.json").read_text())
TOKENS = json.loads((RECORDED / "tokens.json").read_text())
SAMPLES = [json.loads(line) for line in (RECORDED / "wire.jsonl").read_text().splitlines()]
UNKNOWN = ("sensor_msgs/srv/SetCameraInfo", "visualization_msgs/srv/GetInteractiveMarkers")
"""Services that nothing here speaks."""
GENERATED = {
    "control_msgs/action/GripperCommand": "e17c0e644eccf14bea84a0a93e0977182872c2eb7873ca6694900059b46dbc84",
    "control_msgs/action/ParallelGripperCommand": "adfd3c1ebe8abc38ebcc0e454b6423d291d4010dd5697d14eca5b9be4726ae18",
    "moveit_msgs/msg/DisplayTrajectory": "dd351cbd6d9986eb019306910ec09236a136a02dbc0b3465707cb62f2d56e22b",
    "vision_msgs/msg/Detection3DArray": "793f5eab9595ac1c0da07873cc859db42eae51f0ee76056db8562515d830e018",
}
"""Hashes as the generated code in ROS 2 workspaces has them; that of an action is made of all its parts."""
ROSOUT = "%rosout"


def test_hashes_are_those_of_genuine_nodes() -> None:
    types = Types.of("jazzy")
    known = {name: hash for name, hash in REFERENCE["rihs01"].items() if not name.startswith(UNKNOWN)}
    assert len(known) == 157
    assert {name: types.hash(name) for name in known} == known
    assert {name: types.hash(name) for name in GENERATED} == {
        name: f"RIHS01_{hash}" for name, hash in GENERATED.items()
    }


def test_control_messages_differ_between_distributions() -> None:
    feedback = "control_msgs/action/FollowJointTrajectory_FeedbackMessage"
    hashes = [Types.of(one).hash(feedback) for one in ("jazzy", "kilted", "lyrical")]
    assert [hash[7:15] for hash in hashes] == ["80398fcb", "95618cc7", "95618cc7"]
    assert matching(feedback, hashes[0]) == ["jazzy"]


@pytest.mark.parametrize("name", REFERENCE["cdr"])
def test_bytes_are_those_of_genuine_serialisers(name: str) -> None:
    assert_equal_but_padding(name, bytes.fromhex(REFERENCE["cdr"][name]))


def test_every_recorded_sample_is_read_and_written() -> None:
    for sample in SAMPLES:
        name = ros_name(sample["key"].split("/")[-2]) + ("_Response" if sample["kind"] == "reply" else "")
        assert_equal_but_padding(name, bytes.fromhex(sample["payload"]))
        attachment = bytes.fromhex(sample["att"])
        assert bytes(Attachment.parse(attachment)) == attachment


def assert_equal_but_padding(name: str, genuine: bytes) -> None:
    """A byte may differ where changing it changes nothing that is read; genuine padding is not initialised."""
    types = Types.of("jazzy")
    ours = types.encode(types.decode(genuine, name))
    assert len(ours) <= len(genuine) <= len(ours) + 8
    for place in [k for k in range(len(ours)) if ours[k] != genuine[k]]:
        changed = ours[:place] + genuine[place : place + 1] + ours[place + 1 :]
        assert types.encode(types.decode(changed, name)) == ours, f"byte {place} is no padding"


def test_tokens_keys_and_gids_are_those_of_genuine_nodes() -> None:
    endpoints = {token: Endpoint.parse(token) for token in TOKENS}
    nodes = [token for token, endpoint in endpoints.items() if endpoint is None]
    assert [token.split("/")[5] for token in nodes] == ["NN", "NN"]
    spoken = [endpoint for endpoint in endpoints.values() if endpoint is not None]
    written = {token: endpoint.token for token, endpoint in endpoints.items() if endpoint is not None}
    assert all(token == ours for token, ours in written.items() if ROSOUT not in token)  # it has a lifespan
    assert {endpoint.owner.token for endpoint in spoken} == set(nodes)
    by_gid = {endpoint.gid: endpoint for endpoint in spoken}
    for sample in SAMPLES:
        assert by_gid[Attachment.parse(bytes.fromhex(sample["att"])).gid].key == sample["key"]


def test_qualities_of_service() -> None:
    assert [str(qos) for qos in (Qos(), LATCHED, SENSOR)] == ["::,10:,:,:,,", ":1:,1:,:,:,,", "2::,5:,:,:,,"]
    assert all(Qos.parse(str(qos)) == qos for qos in (Qos(), LATCHED, SENSOR))
    assert Qos.parse("") == Qos(depth=42)


@pytest.mark.parametrize("token", ["", "@ros2_lv/0/a/0/1/MP/%/%/n/%t", "@ros2_lv/x/a/0/1/MP/%/%/n/%t/T/H/::,1:,:,:,,"])
def test_what_is_no_token_is_nobody(token: str) -> None:
    assert Endpoint.parse(token) is None


def test_a_token_may_say_more_than_is_known_here() -> None:
    assert Endpoint.parse(f"{TOKENS[2]}/backends:cpu") == Endpoint.parse(TOKENS[2])


@pytest.mark.parametrize(
    ("name", "whole"), [("a", "/lab/a"), ("/a", "/a"), ("~/a", "/lab/n/a"), ("b", "/c"), ("~", "/lab/n/")]
)
def test_names(name: str, whole: str) -> None:
    assert full_name(name, "/lab", "n", {"b": "/c"}) == whole


def test_attachments_of_another_form_are_refused() -> None:
    with pytest.raises(ValueError, match="attachment missing: must be 33 bytes with a gid of 16"):
        Attachment.parse(b"")


def test_fields_that_are_not_given_are_zero() -> None:
    types = Types.of("jazzy")
    message: Any = types.new("sensor_msgs/msg/CameraInfo", header={"frame_id": "c"}, k=np.eye(3).ravel(), d=[0.5])
    assert (message.header.frame_id, message.header.stamp.sec, message.distortion_model) == ("c", 0, "")
    assert message.p.tolist() == [0.0] * 12
    assert types.encode(types.decode(types.encode(message), message.__msgtype__)) == types.encode(message)
    assert types.encode(types.new("std_srvs/srv/Trigger_Request")).hex() == "0001000000"


def test_what_is_not_known_is_named() -> None:
    with pytest.raises(Refused, match="my_msgs/msg/Mine: no such ROS 2 interface here"):
        Types.of("jazzy").hash("my_msgs/msg/Mine")
    with pytest.raises(ValueError, match="std_msgs/msg/String: begins with 000a"):
        Types.of("jazzy").decode(b"\0\x0a\0\0", "std_msgs/msg/String")


def test_a_node_in_a_namespace() -> None:
    owner = Owner(domain=3, session="ab", namespace="/a/b", name="n")
    assert owner.full_name == "/a/b/n"
    assert owner.token == "@ros2_lv/3/ab/0/0/NN/%/%a%b/n"
