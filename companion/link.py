"""Links that carry bytes: UDP, TCP and serial behind one small face.  They know nothing of MAVLink.

A link never blocks and never raises once it is open: a peer that goes away, a full buffer or an unplugged device are
counted, and `maintain` opens again what can be opened again.  `open_link` raises UserError for what cannot work at all.
"""

import contextlib
import errno
import os
import socket
import termios
from collections import Counter
from collections.abc import Callable, Hashable
from dataclasses import replace
from typing import Any, Final, Protocol

import serial

from companion.address import Address, Medium
from companion.errors import UserError

DATAGRAM_BYTES: Final = 65_536
CHUNK_BYTES: Final = 16_384
READS: Final = 64  # of one link before the others get their turn
PEERS: Final = 32  # of one listening link; the one silent for longest makes room
REOPEN_US: Final = 1_000_000
DEVICE_ERRORS: Final = (OSError, serial.SerialException, termios.error)  # what a device that goes away may raise
BUFFER_BYTES: Final = 1 << 20  # kernel buffer: a stalled loop must not lose a burst at speed-up


class Link(Protocol):
    """A carrier of bytes to one or several peers."""

    name: str  # canonical connection string
    counts: Counter[str]

    def filenos(self) -> list[int]:
        """What to wait on for reading; empty while the link is down."""

    def receive(self) -> list[tuple[Hashable, bytes]]:
        """What has arrived, by peer, in order; never blocks."""

    def send(self, data: bytes, peer: Hashable | None = None) -> None:
        """To one peer, or to every peer that the link knows."""

    def maintain(self, now_us: int) -> None:
        """Open again what went away; now_us: monotonic."""

    def close(self) -> None: ...


def open_link(address: Address) -> Link:
    """Open the link of an address.  Raises UserError: port in use, unknown host, missing device."""
    try:
        match address.medium:
            case Medium.UDP_LISTEN:
                return UdpListener(address)
            case Medium.UDP_SEND | Medium.UDP_BROADCAST:
                return UdpSender(address)
            case Medium.TCP_CONNECT:
                return TcpClient(address)
            case Medium.TCP_LISTEN:
                return TcpListener(address)
            case Medium.SERIAL:
                return SerialPort(address)
    except socket.gaierror:
        raise UserError(f"{address.canonical}: host {address.host!r} is not known") from None
    except (*DEVICE_ERRORS, ValueError) as error:  # ValueError: a speed that the device does not have
        raise UserError(f"{address.canonical}: {_reason(error)}") from None


def _reason(error: Exception) -> str:
    code = error.errno if isinstance(error, OSError) else None
    if code == errno.EADDRINUSE:
        return "the port is in use by another program; close it or choose another port"
    if code == errno.ENOENT:
        return "there is no such device; is it plugged in?"
    if code == errno.EACCES:
        return "no permission; on Linux a serial device needs the group dialout"
    return " ".join(str(error).split())


def _udp(address: Address) -> socket.socket:
    family, kind, protocol, _, _ = socket.getaddrinfo(address.host, address.port, type=socket.SOCK_DGRAM)[0]
    made = socket.socket(family, kind, protocol)
    made.setblocking(False)
    made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
    return made


def _datagrams(made: socket.socket, counts: Counter[str]) -> list[tuple[Hashable, bytes]]:
    """What has arrived, a bounded number; errors are answers of the network to something sent to a peer that is gone."""
    out: list[tuple[Hashable, bytes]] = []
    for _ in range(READS):
        try:
            data, peer = made.recvfrom(DATAGRAM_BYTES)
        except BlockingIOError:
            break
        except OSError:
            counts["receive_errors"] += 1
            continue
        out.append((peer, data))
    return out


class UdpListener:
    """Bound to a port; learns its peers as they speak."""

    def __init__(self, address: Address) -> None:
        self.name = address.canonical
        self.counts: Counter[str] = Counter()
        self._peers: dict[Any, None] = {}  # in the order of when they last spoke
        self._socket = _udp(address)
        try:
            self._socket.bind((address.host, address.port))
        except OSError:
            self._socket.close()
            raise
        if not address.port:  # any free one
            self.name = replace(address, port=self._socket.getsockname()[1]).canonical

    def filenos(self) -> list[int]:
        return [self._socket.fileno()]

    def receive(self) -> list[tuple[Hashable, bytes]]:
        out = _datagrams(self._socket, self.counts)
        for peer, _ in out:
            self._peers.pop(peer, None)
            self._peers[peer] = None
            if len(self._peers) > PEERS:
                del self._peers[next(iter(self._peers))]
        return out

    def send(self, data: bytes, peer: Hashable | None = None) -> None:
        for target in list(self._peers) if peer is None else [peer]:
            try:
                self._socket.sendto(data, target)  # type: ignore[arg-type]  # a peer is what recvfrom gave
            except OSError:
                self.counts["send_errors"] += 1

    def maintain(self, now_us: int) -> None:
        """A bound port stays bound."""

    def close(self) -> None:
        self._socket.close()


class UdpSender:
    """Speaks to one address, or to a broadcast address until somebody answers."""

    def __init__(self, address: Address) -> None:
        self.name = address.canonical
        self.counts: Counter[str] = Counter()
        self._socket = _udp(address)
        if address.medium is Medium.UDP_BROADCAST:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        self._target: Any = socket.getaddrinfo(address.host, address.port, type=socket.SOCK_DGRAM)[0][4]
        self._broadcasts = address.medium is Medium.UDP_BROADCAST

    def filenos(self) -> list[int]:
        return [self._socket.fileno()]

    def receive(self) -> list[tuple[Hashable, bytes]]:
        out = _datagrams(self._socket, self.counts)
        if out and self._broadcasts:
            self._target, self._broadcasts = out[0][0], False
        return out

    def send(self, data: bytes, peer: Hashable | None = None) -> None:
        target: Any = self._target if peer is None else peer
        try:
            self._socket.sendto(data, target)
        except OSError:
            self.counts["send_errors"] += 1

    def maintain(self, now_us: int) -> None:
        """There is no connection that could be lost."""

    def close(self) -> None:
        self._socket.close()


class _Backlog:
    """What a stream has not taken yet, bounded.  Whole messages are thrown away, never a part of one."""

    def __init__(self) -> None:
        self._waiting = bytearray()

    def push(self, data: bytes, write: Callable[[bytearray], int | None]) -> bool:
        """Write as much as goes; False if there was no room for `data`.  Errors of `write` pass through."""
        fits = len(self._waiting) + len(data) <= BUFFER_BYTES
        if fits:
            self._waiting += data
        with contextlib.suppress(BlockingIOError):
            del self._waiting[: write(self._waiting) or 0]
        return fits


class _Stream:
    """One TCP connection, without blocking."""

    def __init__(self, connection: socket.socket) -> None:
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.socket = connection
        self.closed = False
        self._backlog = _Backlog()

    def receive(self) -> bytes:
        try:
            data = self.socket.recv(CHUNK_BYTES)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self.closed = True
        return data

    def send(self, data: bytes) -> bool:
        """False if the peer reads so slowly that this had to be thrown away."""
        try:
            return self._backlog.push(data, self.socket.send)
        except OSError:
            self.closed = True
            return False


class TcpClient:
    """Connects to a server, and again when it went away."""

    def __init__(self, address: Address) -> None:
        self.name = address.canonical
        self.counts: Counter[str] = Counter()
        self._target: Any
        family, kind, protocol, _, self._target = socket.getaddrinfo(address.host, address.port, type=socket.SOCK_STREAM)[0]
        self._kind = (family, kind, protocol)
        self._stream: _Stream | None = None
        self._next_us = 0
        self._connecting: socket.socket | None = None

    def filenos(self) -> list[int]:
        return [self._stream.socket.fileno()] if self._stream else []

    def receive(self) -> list[tuple[Hashable, bytes]]:
        if self._stream is None:
            return []
        data = self._stream.receive()
        if self._stream.closed:
            self._drop()
        return [(self.name, data)] if data else []

    def send(self, data: bytes, peer: Hashable | None = None) -> None:
        if self._stream is None:
            self.counts["send_errors"] += 1
            return
        self.counts["send_errors"] += not self._stream.send(data)
        if self._stream.closed:
            self._drop()

    def maintain(self, now_us: int) -> None:
        if self._stream is not None or now_us < self._next_us:
            return
        if self._connecting is None:
            self._connecting = socket.socket(*self._kind)
            self._connecting.setblocking(False)
        code = self._connecting.connect_ex(self._target)
        if code in (0, errno.EISCONN):
            self._stream, self._connecting = _Stream(self._connecting), None
            self.counts["connected"] += 1
        elif code not in (errno.EINPROGRESS, errno.EALREADY):
            self._connecting.close()
            self._connecting = None
            self._next_us = now_us + REOPEN_US

    def close(self) -> None:
        self._drop()
        if self._connecting is not None:
            self._connecting.close()

    def _drop(self) -> None:
        if self._stream is not None:
            self._stream.socket.close()
            self._stream = None


class TcpListener:
    """A server; each connection is a peer."""

    def __init__(self, address: Address) -> None:
        self.name = address.canonical
        self.counts: Counter[str] = Counter()
        family = socket.getaddrinfo(address.host, address.port, type=socket.SOCK_STREAM)[0][0]
        self._server = socket.create_server((address.host, address.port), family=family)
        self._server.setblocking(False)
        self._streams: dict[Hashable, _Stream] = {}

    def filenos(self) -> list[int]:
        return [self._server.fileno(), *(stream.socket.fileno() for stream in self._streams.values())]

    def receive(self) -> list[tuple[Hashable, bytes]]:
        self._accept()
        out: list[tuple[Hashable, bytes]] = []
        for peer, stream in list(self._streams.items()):
            if data := stream.receive():
                out.append((peer, data))
            self._forget_closed(peer, stream)
        return out

    def send(self, data: bytes, peer: Hashable | None = None) -> None:
        targets = list(self._streams.items()) if peer is None else [(peer, self._streams.get(peer))]
        for name, stream in targets:
            if stream is None:
                self.counts["send_errors"] += 1
                continue
            self.counts["send_errors"] += not stream.send(data)
            self._forget_closed(name, stream)

    def maintain(self, now_us: int) -> None:
        self._accept()

    def close(self) -> None:
        self._server.close()
        for stream in self._streams.values():
            stream.socket.close()
        self._streams.clear()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):  # nobody waits, or has gone again already
            while len(self._streams) < PEERS:
                connection, peer = self._server.accept()
                self._streams[peer] = _Stream(connection)

    def _forget_closed(self, peer: Hashable, stream: _Stream) -> None:
        if stream.closed:
            stream.socket.close()
            self._streams.pop(peer, None)


class SerialPort:
    """A UART, USB or pseudo terminal; opened again after it went away."""

    def __init__(self, address: Address) -> None:
        self.name = address.canonical
        self.counts: Counter[str] = Counter()
        self._address = address
        self._next_us = 0
        self._port: serial.Serial | None = self._open()

    def filenos(self) -> list[int]:
        return [self._port.fileno()] if self._port else []

    def receive(self) -> list[tuple[Hashable, bytes]]:
        if self._port is None:
            return []
        try:
            data = self._port.read(CHUNK_BYTES)
        except (*DEVICE_ERRORS, TypeError):  # TypeError: pyserial, closed under its read
            self._drop()
            return []
        return [(self.name, data)] if data else []

    def send(self, data: bytes, peer: Hashable | None = None) -> None:
        if self._port is None:
            self.counts["send_errors"] += 1
            return
        handle = self._port.fileno()
        try:  # not the port's own write: with a full buffer it tries again for ever
            self.counts["send_errors"] += not self._backlog.push(data, lambda waiting: os.write(handle, waiting))
        except DEVICE_ERRORS:
            self._drop()

    def maintain(self, now_us: int) -> None:
        if self._port is not None or now_us < self._next_us:
            return
        self._next_us = now_us + REOPEN_US
        with contextlib.suppress(*DEVICE_ERRORS):
            self._port = self._open()
            self.counts["reopened"] += 1

    def close(self) -> None:
        self._drop()

    def _open(self) -> serial.Serial:
        address = self._address
        self._backlog = _Backlog()
        return serial.Serial(
            address.device, address.baud, timeout=0, write_timeout=0, rtscts=address.flow_control, exclusive=True
        )

    def _drop(self) -> None:
        if self._port is not None:
            with contextlib.suppress(*DEVICE_ERRORS):
                self._port.close()
            self._port = None
            self.counts["lost"] += 1
