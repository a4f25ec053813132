"""The straight way between two processes of one machine: a socket for what is small, shared memory for what is large.

A consumer opens a :class:`Door`, a publisher a :class:`Link` to it. What a link has sent is the kernel's: it arrives
even if the publisher is killed at that moment. With Zenoh, which goes everywhere, a message is handed from thread to
thread four times on its way (docs/performance.md).
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import select
import socket
import struct
import threading
import time
from array import array
from collections import Counter, deque
from collections.abc import Callable, Sequence
from functools import partial

from runner.message.codec import CodecError
from runner.message.packet import Packet, Process, badge
from runner.transport.arena import Block, Store, Window

INLINE_BYTES = 8192
"""Larger messages lie in shared memory."""
_LONGEST = INLINE_BYTES + 1024
"""Bytes of a packet at most, with its key."""
_QUEUE = 512
_HEAD = struct.Struct("<BqH")
"""Kind, monotonic time of sending, length of the key; the key and the rest follow."""
_HELLO, _INLINE, _BLOCK, _ARENA = range(4)
_PLACE = struct.Struct("<IQQ")
"""Number of an arena, where in it, how many bytes."""
_RETURN = struct.Struct("<IQ")
"""The same of a block that is given back."""
_CREDENTIALS = struct.Struct("3i")
_TRUNCATED = int(socket.MSG_TRUNC)
_ANCILLARY_BYTES = socket.CMSG_SPACE(struct.calcsize("i"))


def address_of(run: str, secret: str, host: str, process: Process) -> bytes:
    """Where a process' door is: an abstract name, which goes with the process and exists on one machine only."""
    name = hashlib.blake2b(f"{run}/{host}/{process.path}".encode(), key=secret.encode(), digest_size=16)
    return b"\0runner/" + name.hexdigest().encode()


class Link:
    """The publisher's end. May be used from any thread."""

    def __init__(self, address: bytes, secret: str, own: str, store: Store):
        """Connects; raises OSError where there is no door on this machine."""
        self._store = store
        self._shown: set[int] = set()
        self._lent: Counter[tuple[int, int]] = Counter()
        self._changing = threading.Lock()
        self._showing = threading.Lock()
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            self._socket.connect(address)
            if _user_of(self._socket) != os.getuid():
                raise PermissionError("another user's door")
        except OSError:
            self._socket.close()
            raise
        self._socket.setblocking(False)
        self._put(_HELLO, own, _hello(secret, own))

    def send(self, key: str, payload: bytes | Block) -> bool:
        """Sends; waits where the other end is full. False where nobody is there any more."""
        try:
            if not isinstance(payload, Block) and len(payload) > INLINE_BYTES:
                payload = self._store.write([payload])
            if isinstance(payload, Block):
                self._lend(payload, key)
            else:
                self._put(_INLINE, key, payload)
        except OSError:
            return False
        return True

    def collect(self) -> bool:
        """Takes what the reader has given back; False once it is gone, and everything with it."""
        while True:
            try:
                returned, _ = _received(self._socket, _RETURN.size)
            except BlockingIOError:
                return True
            except ConnectionResetError:
                continue
            if not returned:
                self._take_all_back()
                return False
            self._take_back(*_RETURN.unpack(returned))

    def close(self) -> None:
        """Ends the link; what was sent still arrives."""
        self._socket.close()

    def _put(self, kind: int, key: str, payload: bytes, descriptors: Sequence[int] = ()) -> None:
        name = key.encode()
        packet = b"".join((_HEAD.pack(kind, time.monotonic_ns(), len(name)), name, payload))
        while True:
            with contextlib.suppress(BlockingIOError):
                if descriptors:
                    socket.send_fds(self._socket, [packet], descriptors)
                else:
                    self._socket.send(packet)
                return
            _wait_for_room(self._socket)

    def _lend(self, block: Block, key: str) -> None:
        place = block.place
        self._show(place.arena)
        with self._changing:
            self._lent[place.arena, place.offset] += 1
        self._store.lend(block)
        self._put(_BLOCK, key, _PLACE.pack(place.arena, place.offset, place.size))

    def _show(self, arena: int) -> None:
        with self._showing:
            if arena not in self._shown:
                self._put(_ARENA, "", _PLACE.pack(arena, 0, 0), [self._store.descriptor(arena)])
                self._shown.add(arena)

    def _take_back(self, arena: int, offset: int) -> None:
        with self._changing:
            if self._lent[arena, offset] > 0:
                self._lent[arena, offset] -= 1
                self._store.give_back(arena, offset)

    def _take_all_back(self) -> None:
        with self._changing:
            for arena, offset in self._lent.elements():
                self._store.give_back(arena, offset)
            self._lent.clear()


class Door:
    """The consumer's end of all links to it."""

    def __init__(
        self,
        address: bytes,
        secret: str,
        receive: Callable[[Packet], None],
        refuse: Callable[[str, Exception], None],
    ):
        """``receive`` is called by whoever calls :meth:`look`; ``refuse`` is told of what is malformed."""
        self._secret = secret
        self._receive = receive
        self._refuse = refuse
        self._guests: dict[int, _Guest] = {}
        self._after: deque[Callable[[], None]] = deque()
        self._owed: deque[tuple[_Guest, bytes]] = deque()
        """What could not be given back at once."""
        self._looking = threading.Lock()
        self._bell = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
        self._socket.bind(address)
        self._socket.listen(_QUEUE)
        self._epoll = select.epoll()
        self._epoll.register(self._bell, select.EPOLLIN)
        self._epoll.register(self._socket, select.EPOLLIN)

    def look(self, *, wait: bool) -> None:
        """Takes everything that is there; waits for something if wanted, or for a knock."""
        with self._looking:
            self._look(wait=wait)

    def tend(self) -> None:
        """Takes what is there for one that is busy elsewhere, so that no publisher waits for long."""
        if self._looking.acquire(blocking=False):
            try:
                if self._look(wait=False):
                    self.knock()
            finally:
                self._looking.release()

    def knock(self) -> None:
        """Makes who waits look up. May be called from any thread and from a signal handler."""
        os.eventfd_write(self._bell, 1)

    def after_all(self, action: Callable[[], None]) -> None:
        """Acts, in the thread that looks, once everything is taken that is there now."""
        self._after.append(action)
        self.knock()

    def close(self) -> None:
        """Lets nobody in any more, and everybody go."""
        with self._looking:
            for guest in self._guests.values():
                guest.socket.close()
            self._guests.clear()
            self._epoll.close()
            self._socket.close()
            os.close(self._bell)

    def _look(self, *, wait: bool) -> int:
        """Returns how many guests and callers there were."""
        seen, began_ns = 0, time.monotonic_ns()
        events = self._epoll.poll(None if wait else 0)
        while True:
            for descriptor, _ in events:
                self._attend(descriptor, began_ns)
            seen, due = seen + len(events), len(self._after)
            if not (events := self._epoll.poll(0)):
                break
        for _ in range(due):
            self._after.popleft()()
        for _ in range(len(self._owed)):
            guest, place = self._owed.popleft()
            guest.give_back(place)
        return seen

    def _attend(self, descriptor: int, began_ns: int) -> None:
        if descriptor in self._guests:
            self._read(self._guests[descriptor], began_ns)
        elif descriptor == self._bell:
            os.eventfd_read(descriptor)
        else:
            self._let_in()

    def _let_in(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while True:
                connection, _ = self._socket.accept()
                if _user_of(connection) != os.getuid():
                    self._refuse("door", CodecError("door", "", "another user's process"))
                    connection.close()
                    continue
                connection.setblocking(False)
                self._guests[connection.fileno()] = _Guest(connection, self._owed)
                self._epoll.register(connection, select.EPOLLIN)

    def _read(self, guest: _Guest, began_ns: int) -> None:
        """The next that a guest has sent; one that is gone or sends what is malformed is let go."""
        try:
            packet = guest.read(self._secret, began_ns)
            if packet is not None:
                self._receive(packet)
        except EOFError:
            self._let_go(guest)
        except CodecError as error:
            self._refuse(guest.name, error)
            self._let_go(guest)

    def _let_go(self, guest: _Guest) -> None:
        descriptor = guest.socket.fileno()
        self._epoll.unregister(descriptor)
        del self._guests[descriptor]
        guest.leave()


class _Guest:
    """One publisher at the door."""

    def __init__(self, connection: socket.socket, owed: deque[tuple[_Guest, bytes]]):
        self.socket = connection
        self.name = "door"
        self._owed = owed
        self._known = False
        self._windows: dict[int, Window] = {}

    def read(self, secret: str, began_ns: int) -> Packet | None:
        """The next message, None where what came is not one.

        Raises EOFError where none will come any more, CodecError for what no publisher of this run sends.
        """
        try:
            data, descriptors = _received(self.socket, _LONGEST)
        except (BlockingIOError, ConnectionResetError):
            return None
        if not data:
            raise EOFError
        try:
            return self._take(data, descriptors, secret, began_ns)
        except (struct.error, LookupError, ValueError, OSError) as error:
            raise CodecError(self.name, "", f"a malformed packet: {error!r}") from None
        finally:
            for descriptor in descriptors:
                os.close(descriptor)

    def leave(self) -> None:
        """Takes no more; what is still read is given back before the socket goes with the last of it."""
        with contextlib.suppress(OSError):
            self.socket.shutdown(socket.SHUT_RD)

    def __del__(self) -> None:
        self.socket.close()

    def give_back(self, place: bytes) -> None:
        """Tells the publisher that a block is not needed any more. Never waits, for garbage collection may call it."""
        try:
            self.socket.send(place)
        except BlockingIOError:
            self._owed.append((self, place))
        except OSError:
            return

    def _take(self, data: bytes, descriptors: Sequence[int], secret: str, began_ns: int) -> Packet | None:
        kind, sent_ns, length = _HEAD.unpack_from(data)
        end = _HEAD.size + length
        key, rest = data[_HEAD.size : end].decode(), data[end:]
        if not self._known:
            self._require_genuine(kind, key, rest, secret)
            return None
        if kind == _ARENA:
            self._windows[_PLACE.unpack(rest)[0]] = Window(descriptors[0])
            return None
        payload = rest if kind == _INLINE else self._read_block(*_PLACE.unpack(rest))
        # What was there before anybody looked has arrived when it was sent.
        arrived_ns = sent_ns if sent_ns < began_ns else time.monotonic_ns()
        return Packet(key, payload, sent_ns, arrived_ns, near=True)

    def _read_block(self, arena: int, offset: int, size: int) -> memoryview:
        give_back = partial(self.give_back, _RETURN.pack(arena, offset))
        return self._windows[arena].read(offset, size, give_back)

    def _require_genuine(self, kind: int, name: str, shown: bytes, secret: str) -> None:
        if kind != _HELLO or shown != _hello(secret, name):
            raise CodecError(self.name, "", "not sent by a process of this run")
        self._known, self.name = True, name


def _hello(secret: str, name: str) -> bytes:
    return badge(secret, f"door/{name}")


def _user_of(connection: socket.socket) -> int:
    """Who is at the other end."""
    credentials = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    return _CREDENTIALS.unpack(credentials)[1]


def _received(connection: socket.socket, size: int) -> tuple[bytes, Sequence[int]]:
    """A packet and the descriptors that came with it; empty once the other end is gone.

    Raises BlockingIOError where there is none, CodecError where it is too long, and ConnectionResetError once for an
    end that was closed before it read everything: what it has sent is still there.
    """
    data, ancillary, flags, _ = connection.recvmsg(size, _ANCILLARY_BYTES)
    descriptors = [one for _, _, packed in ancillary for one in array("i", packed)] if ancillary else ()
    if flags & _TRUNCATED:
        for descriptor in descriptors:
            os.close(descriptor)
        raise CodecError("door", "", f"a packet of more than {size} bytes")
    return data, descriptors


def _wait_for_room(connection: socket.socket) -> None:
    room = select.poll()
    room.register(connection, select.POLLOUT)
    room.poll()
