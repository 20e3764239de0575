"""Flockwave over TCP (one message a line) and UDP (one a datagram): one thread, many peers, none of which can hold up another.

A line that is too long, or nothing that is understood, is skipped; a connection ends when its peer ends it or does not read any more.
"""

import selectors
import socket
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from time import monotonic
from typing import Final

from rtkmesh_services.control.flockwave.envelope import MAXIMUM_BYTES
from rtkmesh_services.waker import Waker

POLL_S: Final = 0.25
HEARD_S: Final = 60.0  # so long after its last datagram a peer is told what happens
MAXIMUM_PEERS: Final = 256  # that are remembered for notifications
MAXIMUM_WAITING: Final = 1 << 20  # bytes that a client has not read
_READ: Final = 65536

Address = tuple[str, int]


@dataclass(slots=True, eq=False)
class Client:
    """A TCP connection."""

    socket: socket.socket
    rest: bytearray = field(default_factory=bytearray)
    skipping: bool = False
    out: bytearray = field(default_factory=bytearray)


@dataclass(frozen=True, slots=True)
class Datagrams:
    """Who sends datagrams from an address."""

    address: tuple[str, int] | tuple[str, int, int, int]


Peer = Client | Datagrams
OnMessage = Callable[[bytes, Peer], bool]


class FlockwaveServer:
    """``on_message`` is called in the server's thread; it returns whether it took the message. ``send``, ``tell_all``: any thread."""

    def __init__(self, tcp: Address | None, udp: Address | None, on_message: OnMessage, maximum_clients: int = 64) -> None:
        """Listen; OSError where an address cannot be had."""
        self._on_message, self._maximum_clients = on_message, maximum_clients
        self.counters = {"clients": 0, "lines": 0, "lines_too_long": 0, "not_taken": 0, "clients_refused": 0, "clients_stalled": 0}
        self._clients: dict[socket.socket, Client] = {}
        self._peers: dict[Datagrams, float] = {}
        self._pending: deque[tuple[Peer | None, bytes]] = deque()
        self._stopping = threading.Event()
        self._listener = None if tcp is None else socket.create_server(tcp, family=_family(tcp))
        self._datagrams = None if udp is None else _bound(udp, self._listener)
        self._waker = Waker()
        self._selector = selectors.DefaultSelector()
        for end in (self._listener, self._datagrams, self._waker.reader):
            if end is not None:
                end.setblocking(False)
                self._selector.register(end, selectors.EVENT_READ)
        self._thread = threading.Thread(target=self._run, daemon=True, name="flockwave")

    @property
    def tcp_port(self) -> int:
        """The port of TCP, 0: none."""
        return 0 if self._listener is None else int(self._listener.getsockname()[1])

    def start(self) -> None:
        """Begin to serve."""
        self._thread.start()

    def close(self) -> None:
        """Stop, and let go of everything."""
        self._stopping.set()
        self._waker.wake()
        self._thread.join(1.0)

    def send(self, peer: Peer, message: bytes) -> None:
        """Send a message to a peer."""
        self._pending.append((peer, message))
        self._waker.wake()

    def tell_all(self, message: bytes) -> None:
        """Send a message to all clients, and to who sent a datagram in the last minute."""
        self._pending.append((None, message))
        self._waker.wake()

    def _run(self) -> None:
        while not self._stopping.is_set():
            for key, events in self._selector.select(POLL_S):
                if key.fileobj is self._listener:
                    self._accept()
                elif key.fileobj is self._datagrams:
                    self._receive()
                elif key.fileobj is self._waker.reader:
                    self._waker.drain()
                else:
                    self._on_client(key.data, events)
            self._spread()
        for client in tuple(self._clients.values()):
            self._drop(client)
        self._selector.close()
        for end in (self._listener, self._datagrams, self._waker):
            if end is not None:
                end.close()

    def _accept(self) -> None:
        assert self._listener is not None, "only a listener accepts"
        try:
            connection, _ = self._listener.accept()
        except OSError:
            return
        if len(self._clients) >= self._maximum_clients:
            self.counters["clients_refused"] += 1
            connection.close()
            return
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client = self._clients[connection] = Client(connection)
        self.counters["clients"] = len(self._clients)
        self._selector.register(connection, selectors.EVENT_READ, client)

    def _on_client(self, client: Client, events: int) -> None:
        try:
            if events & selectors.EVENT_READ:
                self._read(client)
            if client.out and client.socket in self._clients:
                self._write(client)
        except BlockingIOError:
            pass
        except OSError:
            self._drop(client)

    def _read(self, client: Client) -> None:
        data = client.socket.recv(_READ)
        if not data:
            self._drop(client)
            return
        client.rest += data
        *lines, rest = client.rest.split(b"\n")
        client.rest = rest
        for line in lines:
            self._line(client, bytes(line))
        if len(client.rest) > MAXIMUM_BYTES:
            client.skipping = True
            client.rest.clear()

    def _line(self, client: Client, line: bytes) -> None:
        if client.skipping or len(line) > MAXIMUM_BYTES:
            client.skipping = False
            self.counters["lines_too_long"] += 1
        elif line.strip():
            self._take(line, client)

    def _receive(self) -> None:
        assert self._datagrams is not None, "only a socket of datagrams receives them"
        with suppress(OSError):
            data, address = self._datagrams.recvfrom(_READ)
            peer = Datagrams(address)
            self._peers.pop(peer, None)
            self._peers[peer] = monotonic()  # the newest last
            while len(self._peers) > MAXIMUM_PEERS:
                del self._peers[next(iter(self._peers))]
            self._take(data, peer)

    def _take(self, message: bytes, peer: Peer) -> None:
        self.counters["lines"] += 1
        if not self._on_message(message, peer):
            self.counters["not_taken"] += 1

    def _spread(self) -> None:
        """Hand on what is to be sent."""
        while self._pending:
            peer, message = self._pending.popleft()
            if isinstance(peer, Client):
                self._queue(peer, message)
            elif peer is not None:
                self._send_datagram(peer, message)
            else:
                self._tell_all(message)

    def _tell_all(self, message: bytes) -> None:
        for client in tuple(self._clients.values()):
            self._queue(client, message)
        now_s = monotonic()
        self._peers = {peer: heard_s for peer, heard_s in self._peers.items() if now_s - heard_s <= HEARD_S}
        for peer in self._peers:
            self._send_datagram(peer, message)

    def _send_datagram(self, peer: Datagrams, message: bytes) -> None:
        if self._datagrams is not None:
            with suppress(OSError):
                self._datagrams.sendto(message, peer.address)

    def _queue(self, client: Client, message: bytes) -> None:
        if client.socket not in self._clients:
            return
        if len(client.out) + len(message) > MAXIMUM_WAITING:
            self.counters["clients_stalled"] += 1
            self._drop(client)
            return
        client.out += message + b"\n"
        self._on_client(client, selectors.EVENT_WRITE)

    def _write(self, client: Client) -> None:
        """Send as much as the client takes now."""
        try:
            del client.out[: client.socket.send(client.out)]
        finally:
            wanted = selectors.EVENT_READ | (selectors.EVENT_WRITE if client.out else 0)
            self._selector.modify(client.socket, wanted, client)

    def _drop(self, client: Client) -> None:
        if self._clients.pop(client.socket, None) is not None:
            self.counters["clients"] = len(self._clients)
            self._selector.unregister(client.socket)
            client.socket.close()


def _family(address: Address) -> socket.AddressFamily:
    return socket.AF_INET6 if ":" in address[0] else socket.AF_INET


def _bound(address: Address, listener: socket.socket | None) -> socket.socket:
    """Return a socket of datagrams; what was opened before is closed where there is none."""
    made = socket.socket(_family(address), socket.SOCK_DGRAM)
    try:
        made.bind(address)
    except OSError:
        made.close()
        if listener is not None:
            listener.close()
        raise
    return made
