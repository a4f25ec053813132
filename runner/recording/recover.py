"""Writes what a torn or damaged recording still holds as a clean, indexed one."""

from pathlib import Path
from typing import IO

from mcap.writer import CompressionType, Writer

from runner.contract import Refused
from runner.recording.container import Container, Entry, is_being_written, new_file, open_file
from runner.recording.recording import PROFILE, VERDICT, Recording
from runner.recording.writer import CHUNK_BYTES

SUFFIX = ".recovered.mcap"


def recover(path: Path, target: Path | None = None) -> tuple[Recording, Path]:
    """Copies every readable payload, the metadata and the verdict; returns what was read and where it was written.

    By default ``run.mcap`` becomes ``run.recovered.mcap``. Raises Refused where the file is still being written or no
    recording, or where the target exists.
    """
    target = target or path.with_name(path.name.removesuffix(".mcap") + SUFFIX)
    with open_file(path) as file:
        if is_being_written(file):
            raise Refused(f"{path}: is still being written; valid: the recording of a graph that has ended")
    recording = Recording(path)
    with new_file(target) as output:
        _copy(recording, output)
    return recording, target


def _copy(recording: Recording, output: IO[bytes]) -> None:
    verdict = recording.verdict
    writer = Writer(output, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD, enable_data_crcs=True)
    writer.start(profile=PROFILE)
    channels = {number: _register(recording.container, number, writer) for number in recording.container.channels}
    for record in recording.records():
        if isinstance(record, Entry):
            message, channel = record.message, channels[record.message.channel_id]
            writer.add_message(channel, message.log_time, message.data, message.publish_time, message.sequence)
        elif record.name != VERDICT:
            writer.add_metadata(record.name, record.metadata)
    writer.flush()
    writer.add_metadata(VERDICT, verdict.metadata())
    writer.finish()


def _register(container: Container, number: int, writer: Writer) -> int:
    channel = container.channels[number]
    schema = container.schemas.get(channel.schema_id)
    known = writer.register_schema(schema.name, schema.encoding, schema.data) if schema else 0
    return writer.register_channel(channel.topic, channel.message_encoding, known, channel.metadata)
