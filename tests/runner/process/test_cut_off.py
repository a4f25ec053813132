"""Between machines a link may be given up while both of its ends live: one of them is replaced."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from runner.graph.graph import node_entry
from runner.graph.placement import Host, Network
from runner.graph.reading import load_graph
from runner.hosts.keys import credentials, make_keys
from runner.message.codec import envelope, pack
from runner.message.packet import GATEWAY, RECORDER, Packet, Process
from runner.process.children import last_lines, reason_in, spawn
from runner.process.forks import EXIT_FAILED
from runner.process.stage_process import Assignment
from runner.transport.bus import Bus
from runner.transport.presence import Presence
from runner.transport.session import new_endpoint
from tests.runner.common.runs import ALBUM
from tests.runner.common.survivors import Picture
from tests.runner.common.waiting import wait_until

CAMERA = Process("camera", 0)


def missed(presence: Presence) -> list[Process]:
    return presence.cut_off({"camera"}, -1)


def test_who_has_gone_is_missed_until_it_is_known_to_be_dead_also_where_it_is_back():
    presence = Presence()
    for process, present in ((CAMERA, True), (CAMERA, False), (Process("sink", 0), False), (CAMERA, True)):
        presence.update(process, present)
    assert (missed(presence), presence.cut_off({"camera"}, 60)) == ([CAMERA], [])
    presence.ended(CAMERA)
    assert missed(presence) == []


def test_who_has_a_successor_is_dead():
    presence = Presence()
    presence.update(CAMERA, False)
    presence.update(Process("camera", 0, 1), True)
    assert missed(presence) == []


@pytest.mark.parametrize(("gone", "said"), [(CAMERA, "camera.0"), (Process(RECORDER, 0), "the recorder")])
def test_a_process_ends_for_which_another_has_gone_that_nobody_calls_dead(tmp_path: Path, gone: Process, said: str):
    endpoint, keys = new_endpoint("tls/127.0.0.1:0"), tmp_path / "keys"
    make_keys(keys, [Host("head", "127.0.0.1")])
    network = Network("head", "head", ("head",), "tls/127.0.0.1:0", credentials=credentials(keys, "head"))
    head = Bus("run", endpoint, network=network, process=Process(GATEWAY, 0), listen=True)
    presence, others, steps = Presence(), {}, list[Packet]()
    head.subscribe("s/glance", steps.append)
    head.announce()
    for process in (CAMERA, Process(RECORDER, 0)):
        others[process] = Bus("run", endpoint, network=network, process=process)
        others[process].announce()
    others[CAMERA].watch(presence.update)
    node = load_graph(ALBUM, (f"sink.path={tmp_path / 'out.txt'}",)).nodes["glance"]
    task = Assignment(
        "run",
        endpoint,
        str(tmp_path),
        "glance",
        node_entry(node),
        0,
        (),
        (("camera", 0), ("glance", 0)),
        network=network,
    )
    log = tmp_path / "log.txt"
    glance = spawn("tests.runner.process.impatient", task=msgspec.json.encode(task), log=log)
    assert presence.wait_for([("glance", 0)], lambda: glance.poll() is not None), last_lines(log, 9)
    picture = Picture(pixels=np.zeros(1, np.uint8), last=False)
    sealed = envelope(picture, id="camera.picture#0", lineage="camera.picture#0", time_ns=0, causes=())
    others[CAMERA].publish("m/camera/picture", pack(sealed))
    wait_until(lambda: steps)  # it knows all of them
    others.pop(gone).close()
    assert glance.wait(60) == EXIT_FAILED
    assert reason_in(log) == f"cut off from {said}"
    for bus in (*others.values(), head):
        bus.close()
