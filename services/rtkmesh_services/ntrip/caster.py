"""A small caster: one thread, any number of mount points, clients of both versions. Nobody can make it wait or grow.

A client that does not read loses whole frames, the oldest first, and is dropped when it has read nothing for ``STALLED_S``.
Nobody may send: clients' positions are read and forgotten, servers are refused.
"""

import selectors
import socket
import threading
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from time import monotonic
from typing import Final

from rtkmesh_services.ntrip.frames import FrameQueue, StreamPicture
from rtkmesh_services.ntrip.protocol import chunk
from rtkmesh_services.ntrip.request import Request, is_allowed, parse_request, refusal_answer, source_refusal, stream_answer, table_answer
from rtkmesh_services.ntrip.source_table import MountPoint
from rtkmesh_services.waker import Waker

REQUEST_S: Final = 10.0
STALLED_S: Final = 60.0
LINGER_S: Final = 2.0
POLL_S: Final = 0.25
SEND_BUFFER: Final = 65536
AT_ONCE: Final = 16384  # bytes of whole frames that are handed to a socket together
MAXIMUM_PENDING: Final = 4096  # frames between the publisher's thread and ours
MAXIMUM_CONNECTIONS: Final = 32  # beyond the clients: those that still ask or are being answered


@dataclass(frozen=True, slots=True)
class ClientStatus:
    """A client that is being served."""

    mount: str
    address: str
    version: int
    user: str
    agent: str
    bytes: int
    dropped: int


@dataclass(slots=True, eq=False)
class _Client:
    socket: socket.socket
    address: str
    deadline_s: float
    asked: bytes = b""
    request: Request | None = None
    serving: bool = False
    sending: memoryview = field(default_factory=lambda: memoryview(b""))
    queue: FrameQueue = field(default_factory=FrameQueue)
    sent: int = 0

    def wrapped(self, frame: bytes) -> bytes:
        """Return a frame as this client gets it."""
        return chunk(frame) if self.request is not None and self.request.version == 2 else frame


class Caster:
    """Serves frames to clients. ``publish`` and ``describe`` may be called from any thread, and never block."""

    def __init__(
        self,
        host: str,
        port: int,
        mounts: Mapping[str, MountPoint],
        users: Mapping[str, str],
        maximum_clients: int = 64,
        header: bytes = b"",
    ) -> None:
        self._listener = socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET)
        self._listener.setblocking(False)
        self.port: int = self._listener.getsockname()[1]
        self._users, self._maximum_clients, self._header = dict(users), maximum_clients, header
        self._lock = threading.Lock()
        self._rows = dict(mounts)
        self._pictures = {name: StreamPicture() for name in mounts}
        self._pending: deque[tuple[str, bytes]] = deque(maxlen=MAXIMUM_PENDING)
        self._clients: dict[socket.socket, _Client] = {}
        self._waker = Waker()
        self._stopping = threading.Event()
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._selector.register(self._waker.reader, selectors.EVENT_READ)
        self._thread = threading.Thread(target=self._run, daemon=True, name="caster")
        self.refused = self.dropped = 0

    def start(self) -> None:
        """Begin to serve."""
        self._thread.start()

    def close(self) -> None:
        """Stop serving and let go of everything."""
        self._stopping.set()
        self._waker.wake()
        if self._thread.is_alive():
            self._thread.join(2.0)
        else:
            self._let_go()

    def publish(self, mount: str, frame: bytes) -> None:
        """Send a frame to all clients of a mount point."""
        with self._lock:
            self._pending.append((mount, frame))
        self._waker.wake()

    def describe(self, mount: MountPoint) -> None:
        """Say anew what the source table tells of a mount point beside what its frames tell."""
        with self._lock:
            self._rows[mount.name] = mount

    def clients(self) -> list[ClientStatus]:
        """Return who is being served."""
        with self._lock:
            serving = [client for client in self._clients.values() if client.serving]
        return [self._status(client, client.request) for client in serving if client.request is not None]

    def _status(self, client: _Client, request: Request) -> ClientStatus:
        return ClientStatus(request.mount, client.address, request.version, request.user, request.agent, client.sent, client.queue.dropped)

    def _run(self) -> None:
        while not self._stopping.is_set():
            for key, events in self._selector.select(POLL_S):
                if key.fileobj is self._listener:
                    self._accept()
                elif key.fileobj is self._waker.reader:
                    self._waker.drain()
                else:
                    self._on_client(key.data, events)
            self._spread()
            self._expire(monotonic())
        self._let_go()

    def _let_go(self) -> None:
        for client in tuple(self._clients.values()):
            self._drop(client)
        self._selector.close()
        self._listener.close()
        self._waker.close()

    def _accept(self) -> None:
        try:
            connection, address = self._listener.accept()
        except OSError:
            return
        if len(self._clients) >= self._maximum_clients + MAXIMUM_CONNECTIONS:
            self.refused += 1
            connection.close()
            return
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        client = _Client(connection, f"{address[0]}:{address[1]}", monotonic() + REQUEST_S)
        with self._lock:
            self._clients[connection] = client
        self._selector.register(connection, selectors.EVENT_READ, client)

    def _on_client(self, client: _Client, events: int) -> None:
        try:
            if events & selectors.EVENT_READ:
                self._read(client)
            if events & selectors.EVENT_WRITE and client.socket in self._clients:
                self._write(client)
        except BlockingIOError:
            pass
        except OSError:
            self._drop(client)

    def _read(self, client: _Client) -> None:
        data = client.socket.recv(4096)
        if not data:
            self._drop(client)
        elif client.request is None:
            client.asked += data
            client.request = parse_request(client.asked)
            if client.request is not None:
                client.asked = b""
                self._answer(client, client.request)

    def _answer(self, client: _Client, request: Request) -> None:
        version = request.version
        if request.method == "SOURCE":
            self._refuse(client, source_refusal())
        elif request.method != "GET":
            self._refuse(client, refusal_answer(version, "405 Method Not Allowed" if request.method else "400 Bad Request"))
        elif request.mount not in self._pictures:
            self._refuse(client, self._table(version) if version == 1 or not request.mount else refusal_answer(2, "404 Not Found"))
        elif not is_allowed(request, self._users):
            self._refuse(client, refusal_answer(version, "401 Unauthorized", f'WWW-Authenticate: Basic realm="{request.mount}"'))
        elif len(self.clients()) >= self._maximum_clients:
            self._refuse(client, refusal_answer(version, "503 Service Unavailable", "Retry-After: 30"))
        else:
            self._serve(client, request)

    def _serve(self, client: _Client, request: Request) -> None:
        first = [self._header] if self._header else self._pictures[request.mount].station_frames()
        client.sending = memoryview(stream_answer(request.version) + b"".join(map(client.wrapped, first)))
        client.serving, client.deadline_s = True, monotonic() + STALLED_S
        self._write(client)

    def _refuse(self, client: _Client, answer: bytes) -> None:
        """Send an answer and close behind it."""
        self.refused += not answer.startswith((b"SOURCETABLE", b"HTTP/1.1 200"))
        client.sending, client.deadline_s = memoryview(answer), monotonic() + LINGER_S
        self._write(client)

    def _table(self, version: int) -> bytes:
        return table_answer(version, [self._row(name) for name in self._pictures])

    def _row(self, name: str) -> MountPoint:
        row, picture = self._rows[name], self._pictures[name]
        told = {"format": row.format or picture.format, "details": picture.details, "systems": picture.systems, "bitrate": picture.bitrate}
        return replace(row, carrier=2 if picture.has_phases else 0, authentication="B" if self._users else "N", **told)

    def _spread(self) -> None:
        """Hand new frames to the clients of their mount points."""
        with self._lock:
            frames, self._pending = self._pending, deque(maxlen=MAXIMUM_PENDING)
        now_s = monotonic()
        for mount, frame in frames:
            self._pictures[mount].add(frame, now_s)
        for client in tuple(self._clients.values()) if frames else ():
            mine = [frame for mount, frame in frames if client.serving and client.request is not None and client.request.mount == mount]
            for frame in mine:
                client.queue.put(frame, now_s)
            if mine and not client.sending:
                self._on_client(client, selectors.EVENT_WRITE)

    def _write(self, client: _Client) -> None:
        """Send as much as the client takes now."""
        while client.sending or self._next(client):
            try:
                count = client.socket.send(client.sending)
            except BlockingIOError:
                self._selector.modify(client.socket, selectors.EVENT_READ | selectors.EVENT_WRITE, client)
                return
            client.sending, client.sent = client.sending[count:], client.sent + count
            client.deadline_s = monotonic() + STALLED_S if client.serving else client.deadline_s
        self._selector.modify(client.socket, selectors.EVENT_READ, client)
        if not client.serving and client.request is not None:
            with suppress(OSError):
                client.socket.shutdown(socket.SHUT_WR)  # the client closes, or its time is over

    def _next(self, client: _Client) -> bool:
        frames = client.queue.get_some(AT_ONCE)
        client.sending = memoryview(b"".join(map(client.wrapped, frames)))
        return bool(frames)

    def _expire(self, now_s: float) -> None:
        for client in tuple(self._clients.values()):
            idle = client.serving and not client.sending
            if now_s > client.deadline_s and not idle:
                self._drop(client)

    def _drop(self, client: _Client) -> None:
        with self._lock:
            gone = self._clients.pop(client.socket, None)
        if gone is not None:
            self.dropped += client.queue.dropped
            self._selector.unregister(client.socket)
            client.socket.close()
