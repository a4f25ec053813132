"""Old recordings stay alive: a real one of the first runner, whose messages have changed since."""

import json
import re
from pathlib import Path
from typing import cast

import msgspec
import numpy as np
import pytest

from runner.contract import Message, Migration, Refused, Struct, name_of
from runner.graph.ports import port_name
from runner.message.codec import CodecError, Envelope, decode_untyped, json_schema, open_envelope
from runner.message.codec import envelope as envelope_of
from runner.recording.migrations import migrated, without_gained_fields
from runner.recording.recording import Recording
from tests.runner.common.recordings import rewrite
from tests.runner.replay.test_replay import replay, verify
from tests.runner.weather import MIGRATIONS, Outlook, Place, Reading

OLD = Path(__file__).parents[1] / "weather-1.mcap"
OTHER = {**MIGRATIONS, ("Reading", 2): Migration(change=lambda fields: {**fields, "humidity": 0.25})}


def test_an_old_recording_is_read_as_messages_are_today():
    recording = Recording(OLD)
    assert recording.verdict.complete
    reading = open_envelope(Reading, recording.envelope("thermometer.reading#1"))
    assert (reading.humidity, reading.place.station, reading.place.height) == (0.5, "roof 1", 0.0)
    assert len(reading.temperature) == 4
    assert open_envelope(Outlook, recording.envelope("forecaster.forecast#11")).spread == 0.0


def test_an_old_recording_replays():
    code, said = verify(OLD)
    assert code == 0, said
    assert "12" in said


def test_a_class_that_is_renamed_is_known_by_the_name_that_it_had():
    now = envelope_of(Outlook(celsius=np.zeros(1), place=Place(station="roof"), readings=1),
                      id="forecaster.forecast#0", lineage="thermometer.reading#0", time_ns=0, causes=())  # fmt: skip
    assert (now.type, port_name(Outlook), json_schema(Outlook)["title"]) == ("Forecast", "forecast", "Forecast")

    class Longer(Outlook, frozen=True, kw_only=True):
        days: int

    assert name_of(Longer) == "Longer"


def test_what_its_class_has_gained_since_is_no_change():
    code, said = replay(OLD, "--from", "forecaster")
    assert code == 0, said
    assert said.splitlines()[-1] == "NOTHING CHANGES: 12 identical, of 1 stages"
    _, said = replay(OLD, "--until", "forecaster.forecast#3")
    assert "executed again: identical to the recording" in said


def test_a_changed_value_in_an_old_recording_still_diverges(tmp_path: Path):
    mean = Recording(OLD).envelope("forecaster.forecast#3").body
    value = msgspec.msgpack.decode(mean)["celsius"][2][:8]
    path = rewrite(OLD, tmp_path / "changed.mcap", lambda _, data: data.replace(value, value[:7] + b"\x41"))
    code, said = verify(path)
    assert code == 1
    assert "forecaster.forecast#3" in said
    assert "celsius[0]" in said


def test_a_version_without_a_way_to_today_is_refused():
    sealed = Recording(OLD).envelope("thermometer.reading#0")
    with pytest.raises(CodecError, match="Reading 3"):
        open_envelope(Reading, msgspec.structs.replace(sealed, version=4))


def naming(migrations: str, folder: Path) -> Recording:
    """The old recording as if its graph had named a table."""
    graph = json.dumps({**Recording(OLD).graph, "migrations": migrations})
    return Recording(rewrite(OLD, folder / "named.mcap", lambda _, data: data, {"graph": graph}))


def test_the_table_is_the_one_that_the_recorded_graph_names(tmp_path: Path):
    named = naming("tests.runner.recording.test_migrations:OTHER", tmp_path)
    reading = open_envelope(Reading, named.envelope("thermometer.reading#1"))
    assert (reading.humidity, reading.place.station) == (0.25, "roof 1")


def test_what_was_recorded_is_there_without_the_table_that_is_gone(tmp_path: Path):
    named = naming("tests.runner.weathr:MIGRATIONS", tmp_path)
    assert "celsius" in decode_untyped(named.recorded("thermometer.reading#1").body)
    expected = "migrations of graph 'weather': no module 'tests.runner.weathr'; did you mean 'tests.runner.weather'"
    with pytest.raises(Refused, match=re.escape(expected)):
        named.envelope("thermometer.reading#1")


def envelope(kind: str, version: int, **fields: object) -> Envelope:
    body = msgspec.Raw(msgspec.msgpack.encode(fields))
    return Envelope("a.b#0", "a.b#0", 0, kind, version, (), body)


def test_fields_are_renamed_retired_and_changed_in_lists_and_structs_too():
    migration = Migration(
        renamed={"things.pose": "T"}, retired=("colour", "things.age"), change=lambda fields: {**fields, "count": 2}
    )
    things = [{"pose": 1, "age": 7}, {"pose": 2, "age": 8}]
    today = migrated(envelope("Box", 1, colour="red", things=things, n=1), {("Box", 1): migration})
    assert today.version == 2
    assert decode_untyped(today.body) == {"things": [{"T": 1}, {"T": 2}], "n": 1, "count": 2}


def test_what_nothing_became_of_keeps_its_bytes():
    sealed = envelope("Something", 1, x=1)
    assert migrated(sealed, MIGRATIONS) is sealed


class Inner(Struct, frozen=True, kw_only=True):
    y: int = 0
    w: int = 0


class Today(Message, frozen=True, kw_only=True):
    """What has gained ``z``, and inside ``w``."""

    z: int = 0
    x: int = 0
    inner: tuple[Inner, ...] = ()
    tags: dict[str, Inner] = msgspec.field(default_factory=dict[str, Inner])


def test_gained_fields_are_not_compared_and_lost_ones_are():
    old = envelope("Today", 1, x=1, inner=[{"y": 2}])
    new = without_gained_fields(old, envelope("Today", 1, z=0, inner=[{"y": 2, "w": 5}], x=1), Today)
    assert bytes(new.body) == bytes(old.body)
    lost = without_gained_fields(old, envelope("Today", 1, x=1, inner=[{}]), Today)
    assert decode_untyped(lost.body) == {"x": 1, "inner": [{}]}


class Sparse(Message, frozen=True, kw_only=True, omit_defaults=True):
    """What leaves out fields that are as by default."""

    x: int = 0
    inner: Inner = Inner()


def test_where_defaults_are_left_out_another_value_is_a_change():
    old = envelope("Sparse", 1, inner={"y": 2})
    new = without_gained_fields(old, envelope("Sparse", 1, x=5, inner={"y": 2, "w": 1}), Sparse)
    assert decode_untyped(new.body) == {"x": 5, "inner": {"y": 2}}
    same = without_gained_fields(old, envelope("Sparse", 1, inner={"y": 2, "w": 1}), Sparse)
    assert bytes(same.body) == bytes(old.body)


@pytest.mark.parametrize(
    "tags", [{"a": {"y": 1, "w": 0}, "b": {"y": 2}, "extra": {"y": 9}}, {"b": {"y": 2}, "a": {"y": 1}}, {"a": {"y": 1}}]
)
def test_keys_of_a_dict_are_no_fields(tags: dict[str, object]):
    old = envelope("Today", 1, tags={"a": {"y": 1}, "b": {"y": 2}})
    new = without_gained_fields(old, envelope("Today", 1, z=0, tags=tags), Today)
    kept = {key: {"y": inner["y"]} for key, inner in cast("dict[str, dict[str, int]]", tags).items()}
    assert bytes(new.body) == bytes(envelope("Today", 1, tags=kept).body)
    assert bytes(new.body) != bytes(old.body)
