"""Two of our nodes at a router: topics, services, actions, and what goes wrong."""

from pathlib import Path
from typing import Any

import pytest
import zenoh

from runner.contract import Refused
from runner.graph.placement import Host
from runner.hosts.keys import credentials, make_keys
from runner.transport.security import tls
from stages.devices.ros2.node import Node, Received
from stages.devices.ros2.services import ActionClient, Client, Request, Unanswered, serve
from stages.devices.ros2.settings import Link
from stages.devices.ros2.wire import LATCHED
from tests.runner.common.waiting import wait_until
from tests.stages.devices.ros2.lab import PATIENCE, TRAJECTORY, ActionServer, free_port, node, open_router, router

STRING, JOINTS = "std_msgs/msg/String", "sensor_msgs/msg/JointState"
TRIGGER = "std_srvs/srv/Trigger"
POINTS = {"points": [{"positions": [0.1]}, {"positions": [0.2]}]}


def test_messages_arrive_in_order_with_number_and_publisher() -> None:
    got: list[Received] = []
    with router() as endpoint, node(endpoint, "talker") as talker, node(endpoint, "listener") as listener:
        publisher = talker.publisher("joint_states", JOINTS)
        subscription = listener.subscribe("/joint_states", JOINTS, got.append)
        assert listener.wait_for(subscription, PATIENCE) == ""
        assert talker.wait_for(publisher.endpoint, PATIENCE) == ""
        for number in range(20):
            publisher.put(talker.types.new(JOINTS, name=["j1"], position=[number / 10]))
        wait_until(lambda: len(got) == 20)
    assert [one.number for one in got] == list(range(1, 21))
    assert [one.message.position.tolist() for one in got] == [[number / 10] for number in range(20)]
    assert {one.publisher for one in got} == {publisher.endpoint.gid}


def test_who_comes_late_gets_what_was_latched_and_not_what_was_volatile() -> None:
    witnessed: list[str] = []
    latched: list[str] = []
    volatile: list[str] = []
    with (
        router() as endpoint,
        node(endpoint, "talker") as talker,
        node(endpoint, "witness") as witness,
        node(endpoint, "listener") as listener,
    ):
        keeps, forgets = talker.publisher("kept", STRING, LATCHED), talker.publisher("gone", STRING)
        witness.subscribe("gone", STRING, lambda one: witnessed.append(one.message.data))
        assert talker.wait_for(forgets.endpoint, PATIENCE) == ""
        for word in ("first", "second"):
            keeps.put(talker.types.new(STRING, data=word))
            forgets.put(talker.types.new(STRING, data=word))
        wait_until(lambda: witnessed == ["first", "second"])  # so both have gone through the router: now it is late
        listener.subscribe("gone", STRING, lambda one: volatile.append(one.message.data))
        listener.subscribe("kept", STRING, lambda one: latched.append(one.message.data), LATCHED)
        wait_until(lambda: latched)  # asked for after "gone" was subscribed to: the router knows of both
        forgets.put(talker.types.new(STRING, data="third"))
        wait_until(lambda: volatile)
    assert latched == ["second"]
    assert volatile == ["third"]


def test_a_service_answers_each_call_and_may_take_its_time() -> None:
    waiting: list[Request] = []
    with router() as endpoint, node(endpoint, "server") as server, node(endpoint, "client") as client:
        response = server.types.new("std_srvs/srv/SetBool_Response", success=True, message="now")
        serve(server, "now", "std_srvs/srv/SetBool", lambda request: request.answer(response))
        serve(server, "later", TRIGGER, waiting.append)
        assert Client(client, "now", "std_srvs/srv/SetBool").call(seconds=PATIENCE, data=True).message == "now"
        later = Client(client, "later", TRIGGER)
        assert client.wait_for(later.endpoint, PATIENCE) == ""
        future = later.start(seconds=PATIENCE)
        wait_until(lambda: waiting)
        assert not future.done()
        waiting[0].answer(server.types.new(f"{TRIGGER}_Response", success=True, message="at last"))
        assert future.result(5.0).message == "at last"


def test_an_action_gives_feedback_and_a_result() -> None:
    seen: list[float] = []
    with router() as endpoint, node(endpoint, "arm") as arm, node(endpoint, "client") as client:
        server = ActionServer(arm, "/arm/follow")
        actions = ActionClient(client, "/arm/follow", TRAJECTORY)
        assert arm.wait_for(server.feedback.endpoint, PATIENCE) == ""
        goal = actions.send(
            bytes(range(16)),
            seconds=PATIENCE,
            feedback=lambda one: seen.append(float(one.actual.positions[0])),
            trajectory=POINTS,
        )
        status, result = goal.result(5.0)
        wait_until(lambda: len(seen) == 2)
    assert (status, result.error_string, seen) == ("succeeded", "done", [0.1, 0.2])


def test_a_goal_is_canceled_or_rejected() -> None:
    with router() as endpoint, node(endpoint, "arm") as arm, node(endpoint, "client") as client:
        ActionServer(arm, "held", held=True)
        ActionServer(arm, "picky", accepts=False)
        goal = ActionClient(client, "held", TRAJECTORY).send(bytes(16), seconds=PATIENCE, trajectory=POINTS)
        with pytest.raises(TimeoutError):
            goal.result(0.1)
        assert goal.cancel(5.0)
        assert goal.result(5.0)[0] == "canceled"
        with pytest.raises(Unanswered, match="/picky/_action/send_goal: the goal was rejected"):
            ActionClient(client, "picky", TRAJECTORY).send(bytes(16), seconds=PATIENCE)


def test_another_hash_is_named_with_the_distribution_that_has_it() -> None:
    with (
        router() as endpoint,
        node(endpoint, "arm", namespace="lab", distribution="kilted") as arm,
        node(endpoint, "client", distribution="jazzy") as client,
    ):
        ActionServer(arm, "/follow")
        feedback = client.subscribe("/follow/_action/feedback", f"{TRAJECTORY}_FeedbackMessage", print)
        wait_until(lambda: "publishes" in client.obstacle(feedback))
        obstacle = client.obstacle(feedback)
    ours, theirs = (one.types.hash(f"{TRAJECTORY}_FeedbackMessage") for one in (client, arm))
    assert "/follow/_action/feedback: /lab/arm publishes" in obstacle
    assert ours in obstacle and theirs in obstacle and ours != theirs
    assert "set distribution: kilted or lyrical" in obstacle


def test_another_type_and_a_missing_topic_are_named_with_what_there_is() -> None:
    with router() as endpoint, node(endpoint, "talker") as talker, node(endpoint, "listener") as listener:
        talker.publisher("/camera/color", STRING)
        other = listener.subscribe("/camera/color", JOINTS, print)
        missing = listener.subscribe("/camera/colour", STRING, print)
        wait_until(lambda: listener.others("MP"))
        assert listener.obstacle(other) == (f"/camera/color: /talker publishes {STRING} there; wanted is {JOINTS}")
        assert listener.obstacle(missing) == (
            f"/camera/colour: nobody publishes it; there are of type {STRING}: /camera/color"
        )
        with pytest.raises(Unanswered, match=r"/none: nobody serves it; domain 0 at tcp/.* has none"):
            Client(listener, "none", TRIGGER).call(seconds=0.1)


def test_a_server_that_goes_away_ends_the_call() -> None:
    waiting: list[Request] = []
    with router() as endpoint, node(endpoint, "client") as client:
        with node(endpoint, "server") as server:
            serve(server, "slow", TRIGGER, waiting.append)
            slow = Client(client, "slow", TRIGGER)
            assert client.wait_for(slow.endpoint, PATIENCE) == ""
            future = slow.start(seconds=60.0)
            wait_until(lambda: waiting)
            waiting.clear()
        with pytest.raises(Unanswered, match="/slow: the server went away before it answered"):
            future.result(10.0)


def test_a_client_that_goes_away_troubles_nobody() -> None:
    waiting: list[Request] = []
    with router() as endpoint, node(endpoint, "server") as server:
        serve(server, "slow", TRIGGER, waiting.append)
        with node(endpoint, "client") as client:
            slow = Client(client, "slow", TRIGGER)
            assert client.wait_for(slow.endpoint, PATIENCE) == ""
            slow.start(seconds=60.0)
            wait_until(lambda: waiting)
        waiting[0].answer(server.types.new(f"{TRIGGER}_Response", success=True))
        with node(endpoint, "next") as client:
            future = Client(client, "slow", TRIGGER).start(seconds=60.0)
            wait_until(lambda: len(waiting) == 2)
            waiting[1].answer(server.types.new(f"{TRIGGER}_Response", message="well"))
            assert future.result(10.0).message == "well"


def test_a_router_that_is_killed_and_comes_back_is_found_again() -> None:
    got: list[str] = []
    port = free_port()
    first = open_router(port)
    endpoint = f"tcp/127.0.0.1:{port}"
    with node(endpoint, "talker") as talker, node(endpoint, "listener") as listener:
        publisher = talker.publisher("words", STRING)
        subscription = listener.subscribe("words", STRING, lambda one: got.append(one.message.data))
        response = talker.types.new(f"{TRIGGER}_Response", message="there")
        serve(talker, "there", TRIGGER, lambda request: request.answer(response))
        client = Client(listener, "there", TRIGGER)
        assert listener.wait_for(subscription, PATIENCE) == ""
        first.close()
        wait_until(lambda: "nobody publishes it" in listener.obstacle(subscription))
        second = open_router(port)
        assert listener.wait_for(subscription, 30.0) == ""
        assert talker.wait_for(publisher.endpoint, 30.0) == ""
        publisher.put(talker.types.new(STRING, data="again"))
        wait_until(lambda: got)
        assert client.call(seconds=10.0).message == "there"
    second.close()
    assert got == ["again"]


def test_no_router_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stages.devices.ros2.node.CALL_SECONDS", 0.2)
    with pytest.raises(Refused, match=r"no ROS 2 router at tcp/127.0.0.1:1: .*ros2 run rmw_zenoh_cpp rmw_zenohd"):
        Node(Link(router="tcp/127.0.0.1:1"), print)


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"domain": 233}, "link.domain = 233: must lie between 0 and 232"),
        ({"node": "my node"}, "link.node: /my node is no name in ROS 2"),
        ({"namespace": "/lab/1"}, "link.namespace: /lab/1 is no name in ROS 2"),
        ({"router": "localhost"}, "no ROS 2 router at localhost: "),
        ({"router": "tls/127.0.0.1:1", "keys": Path("nowhere/robot")}, "nowhere/robot/cert.pem: "),
    ],
)
def test_odd_settings_are_one_line(settings: dict[str, Any], says: str) -> None:
    with pytest.raises(Refused, match=says) as refused:
        Node(Link(**settings), print)
    assert "\n" not in str(refused.value)


def test_odd_topics_are_one_line() -> None:
    with router() as endpoint, node(endpoint, "one", remap={"words": "/a b"}) as one:
        with pytest.raises(Refused, match="words: /a b is no name in ROS 2"):
            one.publisher("words", STRING)
        with pytest.raises(Refused, match=r"my_msgs/msg/Mine: no such ROS 2 interface here"):
            one.publisher("mine", "my_msgs/msg/Mine")


def test_keys_let_a_node_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_keys(tmp_path, [Host("lab", "127.0.0.1"), Host("robot", "127.0.0.1")])
    port = free_port()
    session = open_router(port, "tls", **{"transport/link/tls": tls(credentials(tmp_path, "lab"))})
    with node(f"tls/127.0.0.1:{port}", "in", keys=tmp_path / "robot") as one:
        assert one.others("MP") == []
    monkeypatch.setattr("stages.devices.ros2.node.CALL_SECONDS", 0.5)
    with pytest.raises(Refused, match="no ROS 2 router"):
        Node(Link(router=f"tls/127.0.0.1:{port}"), print)
    session.close()


def test_what_cannot_be_read_is_left_out_and_named() -> None:
    got: list[Received] = []
    said: list[str] = []
    with router() as endpoint, node(endpoint, "listener", said) as listener, node(endpoint, "odd") as odd:
        subscription = listener.subscribe("words", STRING, got.append)
        publisher = odd.publisher("words", STRING)
        assert odd.wait_for(publisher.endpoint, PATIENCE) == ""
        odd.session.put(subscription.key, odd.types.encode(odd.types.new(STRING, data="anonymous")))
        odd.session.put(subscription.key, b"\0\1\0\0\xff\xff\0\0", attachment=b"\0" * 16 + b"\x10" + b"\0" * 16)
        publisher.put(odd.types.new(STRING, data="well"))
        wait_until(lambda: got)
    assert [one.message.data for one in got] == ["well"]
    assert ["/words: a message is left out" in line for line in said] == [True, True]


def test_domains_namespaces_and_other_names() -> None:
    got: list[str] = []
    with (
        router() as endpoint,
        node(endpoint, "talker", namespace="lab", remap={"words": "/said"}, domain=7) as talker,
        node(endpoint, "listener", domain=7) as listener,
        node(endpoint, "stranger", domain=8) as stranger,
    ):
        publisher = talker.publisher("words", STRING, LATCHED)
        publisher.put(talker.types.new(STRING, data="here"))
        listener.subscribe("/said", STRING, lambda one: got.append(one.message.data), LATCHED)
        wait_until(lambda: got)
        assert publisher.endpoint.owner.full_name == "/lab/talker"
        assert stranger.others("MP") == []
    assert got == ["here"]


def test_others_see_the_node_in_the_graph() -> None:
    with router() as endpoint, node(endpoint, "talker", namespace="lab") as talker:
        publisher, zid = talker.publisher("words", STRING), str(talker.session.info.zid())
        tokens = {f"@ros2_lv/0/{zid}/0/0/NN/%/%lab/talker", publisher.endpoint.token}
        config = zenoh.Config.from_json5(f'{{mode: "client", connect: {{endpoints: ["{endpoint}"]}}}}')
        with zenoh.open(config) as session:
            wait_until(lambda: _tokens(session) == tokens)


def _tokens(session: zenoh.Session) -> set[str]:
    return {str(reply.ok.key_expr) for reply in session.liveliness().get("@ros2_lv/**") if reply.ok is not None}
