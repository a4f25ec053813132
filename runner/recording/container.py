"""Reads the records of an MCAP file in order or by offset, also where it is torn, damaged or still growing."""

from __future__ import annotations

import contextlib
import fcntl
import os
import struct
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import IO, cast

import mcap.stream_reader
import mcap.writer
from isal import isal_zlib
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, InvalidMagic, McapError, RecordLengthLimitExceeded
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, McapRecord, Metadata, MetadataIndex, Schema
from mcap.records import Message as McapMessage
from mcap.stream_reader import MAGIC_SIZE, CRCValidationError, get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC
from zstandard import ZstdError

from runner.contract import Refused

# Of each byte MCAP's writer takes two checksums and its reader one: in a fifteenth of the time.
for _module in (mcap.stream_reader, mcap.writer):
    vars(_module)["zlib"] = isal_zlib

MAX_RECORD = 2**30
"""Bytes; a longer record is taken for a damaged length."""
POLL_SECONDS = 0.05
_HEAD = struct.Struct("<BQ")
"""Of every record: opcode and length."""
_MESSAGE = struct.Struct("<HIQQ")
"""What then stands before a message's payload: channel, sequence, log and publish time."""
_FOOTER = struct.Struct("<BQQQI8s")
"""The end of a file: opcode, length, where the summary and its offsets begin, its checksum, and the magic number."""
_KINDS: dict[int, type[Channel | Schema | Chunk | ChunkIndex | Metadata | MetadataIndex]] = {
    Opcode.CHANNEL: Channel,
    Opcode.SCHEMA: Schema,
    Opcode.CHUNK: Chunk,
    Opcode.CHUNK_INDEX: ChunkIndex,
    Opcode.METADATA: Metadata,
    Opcode.METADATA_INDEX: MetadataIndex,
}
"""Other records that are read."""

BROKEN = (McapError, ZstdError, ValueError, RuntimeError, KeyError, MemoryError, OverflowError, struct.error)
"""What the MCAP reader and its decompressors raise on bytes that make no sense."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One recorded payload and its topic."""

    topic: str
    message: McapMessage
    """Its payload ``data``, its ``log_time`` (when the recorder received it, nanoseconds since the epoch),
    ``publish_time`` (logical) and ``channel_id``, see :attr:`Container.channels`."""
    offset: int
    """Of the chunk or record that holds it, for :meth:`Container.entries_at`."""


class Container:
    """The payloads and metadata of one MCAP stream."""

    def __init__(self, stream: IO[bytes] | Growing, name: str, known: Container | None = None) -> None:
        """``known`` has read the same file, and knows topics that are named nowhere but at its end."""
        self.damage: list[str] = []
        """Places that do not hold what was written there, as ``byte 4711: reason``."""
        self.torn = True
        """True until the end is found where the writer put it."""
        self.unknown = 0
        """Payloads whose topic stood in a part of the file that is damaged."""
        self._stream = stream
        self._name = name
        self._again = known is not None
        self.channels: dict[int, Channel] = known.channels if known else {}
        self.schemas: dict[int, Schema] = known.schemas if known else {}

    def __iter__(self) -> Iterator[Entry | Metadata]:
        """Everything up to the end or the tear; raises Refused where the stream is no MCAP at all.

        Where it is not known where the next record begins, reading goes on where the summary says that one does.
        """
        records, reached = _records(self._stream), 0
        while True:
            offset = self._stream.tell()
            try:
                record = next(records)
            except StopIteration:
                self.torn = False
                if self._stream.read(1):
                    self._note(self._stream.tell() - 1, "the file goes on after its end")
                return
            except BROKEN as error:
                if offset == 0 and self._stream.tell() <= MAGIC_SIZE:
                    foreign = isinstance(error, InvalidMagic)
                    what = "not an MCAP file" if foreign else "empty or cut off in its first bytes"
                    raise Refused(f"{self._name}: {what}") from None
                self._note(offset, _reason(error))
                reached = next((place for place in _places(self._stream) if place > reached), 0)
                if not reached:
                    return
                self._stream.seek(reached)
                records = _records(self._stream, whole=False)
                continue
            reached = offset if isinstance(record, Chunk | Metadata) else reached
            yield from self._entries(record, offset)

    def entries_at(self, file: IO[bytes], offset: int, end: int | None = None) -> Iterator[Entry]:
        """The entries between two places where records begin, by default those of one chunk; of the same file."""
        file.seek(offset)
        records = _records(file, whole=False)
        while (at := file.tell()) < (offset + 1 if end is None else end):
            try:
                record = next(records)
            except StopIteration:
                return
            except BROKEN as error:
                self._note(at, _reason(error))
                return
            yield from (entry for entry in self._entries(record, at) if isinstance(entry, Entry))

    def _entries(self, record: McapRecord | str | None, offset: int) -> Iterator[Entry | Metadata]:
        for inner in self._opened(record, offset) if isinstance(record, Chunk) else (record,):
            match inner:
                case Channel():
                    self.channels.setdefault(inner.id, inner)
                case Schema():
                    self.schemas.setdefault(inner.id, inner)
                case McapMessage(channel_id=id) if id not in self.channels:
                    self.unknown += 1
                case McapMessage():
                    yield Entry(self.channels[inner.channel_id].topic, inner, offset)
                case Metadata():
                    yield inner
                case str():
                    self._note(offset, inner)
                case _:
                    pass

    def _opened(self, chunk: Chunk, offset: int) -> Iterable[McapRecord | None]:
        try:
            return _content(chunk, checked=True)
        except CRCValidationError:
            self._note(offset, "the chunk's checksum does not match its content")
        except BROKEN as error:
            self._note(offset, f"the chunk cannot be opened: {_reason(error)}")
            return ()
        try:
            found = _content(chunk, checked=False)
        except BROKEN as error:
            self._note(offset, f"the chunk cannot be read: {_reason(error)}")
            return ()
        # Of a topic that it names there may be a better word at the end of the file.
        return found if self._again else [one for one in found if isinstance(one, McapMessage)]

    def _note(self, offset: int, reason: str) -> None:
        damage = f"byte {offset}: {reason}"
        if damage not in self.damage:
            self.damage.append(damage)


def message_head(message: McapMessage) -> bytes:
    """What stands before the payload of a message, in one piece: the library packs field by field."""
    head = _HEAD.pack(Opcode.MESSAGE, _MESSAGE.size + len(message.data))
    return head + _MESSAGE.pack(message.channel_id, message.sequence, message.log_time, message.publish_time)


def _records(stream: IO[bytes] | Growing, *, whole: bool = True) -> Iterator[McapRecord | str | None]:
    """Each record, None for one that is not read, or what is wrong with it.

    ``whole`` begins at the first byte of the file, else where any record begins.
    """
    opcode = checksum = 0
    if whole:
        checksum = isal_zlib.crc32(_magic(stream))
    while opcode != Opcode.FOOTER:
        head = _exactly(stream, _HEAD.size)
        opcode, length = _HEAD.unpack(head)
        if length > MAX_RECORD:
            raise RecordLengthLimitExceeded(opcode, length, MAX_RECORD)
        content = _exactly(stream, length)
        if opcode == Opcode.DATA_END:
            # Older files have none for it, which is 0.
            yield _compared("data section", content, checksum) if whole and any(content) else None
            checksum = 0
        elif opcode == Opcode.FOOTER:
            yield _compared("summary", content, isal_zlib.crc32(content[:-4], isal_zlib.crc32(head, checksum)))
        else:
            if whole or opcode != Opcode.CHUNK:  # No summary holds a chunk, which has a checksum of its own.
                checksum = isal_zlib.crc32(content, isal_zlib.crc32(head, checksum))
            yield _record(opcode, content)
    _magic(stream)


def _places(stream: IO[bytes] | Growing) -> list[int]:
    """Where chunks, metadata and the summary begin, if that stands at the end of the file and is sound."""
    places: list[int] = []
    try:
        stream.seek(-_FOOTER.size, os.SEEK_END)
        opcode, _, start, _, _, magic = _FOOTER.unpack(stream.read(_FOOTER.size))
        if (opcode, magic) != (Opcode.FOOTER, MCAP0_MAGIC):
            return []
        stream.seek(start)
        for record in _records(stream, whole=False):
            match record:
                case ChunkIndex(chunk_start_offset=place) | MetadataIndex(offset=place):
                    places.append(place)
                case str():
                    return []
                case _:
                    pass
    except (*BROKEN, OSError):
        return []
    return sorted([*places, start])


def _compared(section: str, last: bytes, checksum: int) -> str | None:
    """What is wrong with a section; the record that ends it ends in its checksum."""
    sound = int.from_bytes(last[-4:], "little") == checksum
    return None if sound else f"the checksum of the {section} does not match its content"


def _exactly(stream: IO[bytes] | Growing, size: int) -> bytes:
    data = stream.read(size)
    if len(data) < size:
        raise EndOfFile
    return data


def _magic(stream: IO[bytes] | Growing) -> bytes:
    magic = _exactly(stream, MAGIC_SIZE)
    if magic != MCAP0_MAGIC:
        raise InvalidMagic(magic)
    return magic


def _record(opcode: int, content: bytes | memoryview) -> McapRecord | None:
    if opcode == Opcode.MESSAGE:
        channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(content)
        return McapMessage(channel, log_time, cast("bytes", content[_MESSAGE.size :]), publish_time, sequence)
    kind = _KINDS.get(opcode)
    return kind.read(ReadDataStream(BytesIO(content))) if kind else None


def _content(chunk: Chunk, *, checked: bool) -> list[McapRecord | None]:
    """What a chunk holds; payloads are views into it, for copying them costs more than all else."""
    stream, size = get_chunk_data_stream(chunk, validate_crc=checked)
    data, at, found = memoryview(stream.read(size)), 0, list[McapRecord | None]()
    while at < size:
        opcode, length = _HEAD.unpack_from(data, at)
        at, end = at + _HEAD.size, at + _HEAD.size + length
        if end > size:
            raise EndOfFile
        found.append(_record(opcode, data[at:end]))
        at = end
    return found


def _reason(error: Exception) -> str:
    text = str(error).splitlines()[0] if str(error) else ""
    return text or {"EndOfFile": "the file ends inside a record"}.get(type(error).__name__, type(error).__name__)


def open_file(path: Path) -> IO[bytes]:
    """Opens a recording for reading; raises Refused naming the recordings beside it where that fails."""
    try:
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise Refused(f"{path}: is no regular file: a recording is read more than once")
        return path.open("rb")
    except IsADirectoryError:
        raise Refused(f"{path}: is a directory; {_beside(path)}") from None
    except FileNotFoundError:
        raise Refused(f"{path}: no such file; {_beside(path.parent)}") from None
    except OSError as error:
        raise Refused(f"{path}: cannot be read: {error.strerror}") from None


@contextlib.contextmanager
def new_file(path: Path) -> Generator[IO[bytes]]:
    """A file to write, in a folder made for it where there is none, that has its name only once all of it is written; a
    kill leaves ``PATH.PID.part``.

    Raises Refused where the name is taken, also meanwhile, or writing fails.
    """
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        _require_free(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.ExitStack() as unfinished:
            with part.open("xb") as file:
                unfinished.callback(part.unlink)
                yield file
            _require_free(path)
            part.rename(path)
            unfinished.pop_all()
    except OSError as error:
        raise Refused(f"{path}: cannot be written: {error.strerror}") from None


def _require_free(path: Path) -> None:
    if os.path.lexists(path):
        raise Refused(f"{path}: cannot be written: File exists")


def recordings_in(folder: Path) -> list[Path]:
    """Recordings, the one that was written last first; without what is no file, as the end of a dead link."""
    written: dict[Path, float] = {}
    for path in folder.glob("*.mcap"):
        with contextlib.suppress(OSError):
            if path.is_file():
                written[path] = path.stat().st_mtime
    return sorted(written, key=written.__getitem__, reverse=True)


def _beside(folder: Path) -> str:
    return f"recordings in {folder}: {', '.join(path.name for path in recordings_in(folder)[:8]) or 'none'}"


class Growing:
    """A file that its writer may still append to: reading waits for the bytes until the writer has let go of it."""

    def __init__(self, file: IO[bytes], stopped: Callable[[], bool] = lambda: False) -> None:
        self._file = file
        self._stopped = stopped

    def read(self, size: int, /) -> bytes:
        """``size`` bytes, fewer only at the end."""
        parts = [self._file.read(size)]
        while (lacking := size - sum(map(len, parts))) > 0:
            ended = self._stopped() or not is_being_written(self._file)
            parts.append(self._file.read(lacking))
            if ended and not parts[-1]:
                break
            if not parts[-1]:
                time.sleep(POLL_SECONDS)
        return b"".join(parts)

    def tell(self) -> int:
        """Position of the next byte."""
        return self._file.tell()

    def seek(self, offset: int, whence: int = os.SEEK_SET, /) -> int:
        """Another position."""
        return self._file.seek(offset, whence)


def hold(file: IO[bytes]) -> None:
    """Marks a file as being written until it is closed, however its process ends."""
    fcntl.flock(file, fcntl.LOCK_EX)


def is_being_written(file: IO[bytes]) -> bool:
    """True while a process holds the file, see :func:`hold`."""
    try:
        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    fcntl.flock(file, fcntl.LOCK_UN)
    return False
