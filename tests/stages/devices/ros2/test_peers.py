"""Spoken with two implementations that others wrote, at one router: pyzeros and zenoh-ros2-sdk."""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import sysconfig
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh
import zenoh_ros2_sdk as sdk

from stages.devices.ros2.node import Received
from stages.devices.ros2.services import Client, serve
from tests.runner.common.waiting import wait_until
from tests.stages.devices.ros2.lab import PATIENCE, node, router

os.environ["CYDR_CACHE_DIR"] = str(Path(__file__).parents[4] / "build" / "cydr")
COMPILES = shutil.which("cc") is not None and Path(sysconfig.get_path("include"), "Python.h").exists()
compiled = pytest.mark.skipif(not COMPILES, reason="pyzeros compiles its codecs: cc and Python.h")
STRING, JOINTS, SET_BOOL = "std_msgs/msg/String", "sensor_msgs/msg/JointState", "std_srvs/srv/SetBool"
DATA = "string data"


@contextlib.contextmanager
def pyzeros_node(endpoint: str) -> Iterator[Any]:
    config = zenoh.Config.from_json5(f'{{mode: "client", connect: {{endpoints: ["{endpoint}"]}}}}')
    import pyzeros

    with zenoh.open(config) as session, pyzeros.auto_context(node="theirs", zenoh_session=session, domain_id=0) as one:
        yield one


@pytest.fixture
def sdk_router() -> Iterator[tuple[str, dict[str, Any]]]:
    """A router, and what tells the SDK, which keeps one session for the whole process, where it is."""
    with router() as endpoint:
        host, _, port = endpoint.removeprefix("tcp/").partition(":")
        yield endpoint, {"router_ip": host, "router_port": int(port), "domain_id": 0}
        sdk.ZenohSession._instance.session.close()
        sdk.ZenohSession._instance = None


@compiled
@pytest.mark.slow
def test_topics_with_pyzeros() -> None:
    from ros2_pyterfaces.cyclone.all_msgs import JointState

    heard: list[Received] = []

    async def exchange(theirs: Any) -> Any:
        subscription = theirs.create_subscriber(JointState, "/from_us", scope=None)
        publisher = theirs.create_publisher(JointState, "/from_them", scope=None)
        subscribed = ours.subscribe("/from_them", JOINTS, heard.append)
        published = ours.publisher("/from_us", JOINTS)
        assert ours.wait_for(subscribed, PATIENCE) == "" == ours.wait_for(published.endpoint, PATIENCE)
        publisher.publish(JointState(name=["j1"], position=[0.5]))
        published.put(ours.types.new(JOINTS, header={"frame_id": "base"}, name=["a", "bc"], velocity=[1.0, 2.0]))
        return await asyncio.wait_for(anext(subscription.listen_reliable()), PATIENCE)

    with router() as endpoint, node(endpoint, "ours") as ours, pyzeros_node(endpoint) as theirs:
        got = asyncio.run(exchange(theirs))
        wait_until(lambda: heard)
    assert (got.header.frame_id, list(got.name), list(got.velocity)) == ("base", ["a", "bc"], [1.0, 2.0])
    assert (heard[0].message.name, heard[0].message.position.tolist()) == (["j1"], [0.5])


@compiled
@pytest.mark.slow
def test_services_with_pyzeros() -> None:
    from ros2_pyterfaces.cyclone.all_srvs import SetBool

    async def exchange(theirs: Any) -> tuple[Any, Any]:
        server = theirs.create_service(SetBool, "/theirs", scope=None)
        client = theirs.create_client(SetBool, "/ours", scope=None)
        await asyncio.wait_for(client.wait_for_service(), PATIENCE)
        answer = await asyncio.wait_for(client.call_async(SetBool.Request(data=True)), PATIENCE)
        call = asyncio.to_thread(Client(ours, "/theirs", SET_BOOL).call, seconds=PATIENCE, data=True)
        asked = asyncio.create_task(call)
        responder = await asyncio.wait_for(anext(server.listen_reliable()), PATIENCE)
        responder.response.success, responder.response.message = responder.request.data, "theirs"
        responder.send()
        return answer, await asked

    with router() as endpoint, node(endpoint, "ours") as ours, pyzeros_node(endpoint) as theirs:
        response = ours.types.new(f"{SET_BOOL}_Response", success=True, message="ours")
        serve(ours, "/ours", SET_BOOL, lambda request: request.answer(response))
        got, asked = asyncio.run(exchange(theirs))
    assert (got.success, got.message) == (True, "ours")
    assert (asked.success, asked.message) == (True, "theirs")


def test_topics_with_the_sdk(sdk_router: tuple[str, dict[str, Any]]) -> None:
    endpoint, where = sdk_router
    heard: list[Received] = []
    got: list[str] = []
    with node(endpoint, "ours") as ours:
        listener = sdk.ROS2Subscriber("/from_us", STRING, lambda one: got.append(one.data), DATA, **where)
        talker = sdk.ROS2Publisher("/from_them", STRING, DATA, **where)
        subscribed = ours.subscribe("/from_them", STRING, heard.append)
        published = ours.publisher("/from_us", STRING)
        assert ours.wait_for(subscribed, PATIENCE) == "" == ours.wait_for(published.endpoint, PATIENCE)
        # A publisher that has just been declared does not know its listeners yet.
        wait_until(lambda: published.put(ours.types.new(STRING, data="to them")) or got)
        talker.publish(data="to us")
        wait_until(lambda: heard)
        talker.close()
        listener.close()
    assert (got[0], heard[0].message.data) == ("to them", "to us")


def test_services_with_the_sdk(sdk_router: tuple[str, dict[str, Any]]) -> None:
    endpoint, where = sdk_router
    with node(endpoint, "ours") as ours:
        response = ours.types.new(f"{SET_BOOL}_Response", success=True, message="ours")
        serve(ours, "/ours", SET_BOOL, lambda request: request.answer(response))
        texts = ("bool data", "bool success\nstring message")
        client = sdk.ROS2ServiceClient("/ours", SET_BOOL, *texts, **where)
        answer = client.call(data=True)
        client.close()
    assert (answer.success, answer.message) == (True, "ours")
