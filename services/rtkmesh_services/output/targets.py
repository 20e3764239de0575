"""Where an output stream goes: a new file, TCP clients of ours, a TCP server, UDP. A slow or absent taker never slows the solver."""

import socket
from collections.abc import Callable
from pathlib import Path
from typing import Final, Protocol
from urllib.parse import urlsplit

from rtkmesh_services.errors import SourceError

SEND_BUFFER: Final = 1 << 20  # bytes that a TCP client may be behind before it is dropped
RETRY_TICKS: Final = 10


class Target(Protocol):
    """Takes whole lines."""

    detail: str

    def send(self, header: bytes, line: bytes) -> None:
        """Write a line; the header goes before the first one of every file or connection. OSError when it fails."""
        ...

    def tick(self) -> None:
        """Accept, reconnect, flush."""
        ...

    def close(self) -> None:
        """Let go."""
        ...


class FileTarget:
    """A new file; an existing one is never touched."""

    def __init__(self, path: Path) -> None:
        stem, number = path, 0
        while path.exists():
            number += 1
            path = stem.with_name(f"{stem.stem}-{number}{stem.suffix}")
        path.parent.mkdir(parents=True, exist_ok=True)
        self.detail = str(path)
        self._file = path.open("xb")
        self._empty = True

    def send(self, header: bytes, line: bytes) -> None:
        """Append a line."""
        self._file.write(header + line if self._empty else line)
        self._empty = False

    def tick(self) -> None:
        """Hand what was written to the operating system."""
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class TcpListenTarget:
    """A TCP server: every client gets every line; one that does not read is dropped."""

    def __init__(self, host: str, port: int) -> None:
        self._listener = socket.create_server((host, port))
        self._listener.setblocking(False)
        self._clients: list[socket.socket] = []
        self.detail = f"{host}:{port}, no clients"
        self._where = f"{host}:{port}"

    def send(self, header: bytes, line: bytes) -> None:
        """Send a line to all clients."""
        self._accept(header)
        for client in tuple(self._clients):
            try:
                client.sendall(line)
            except OSError:
                client.close()
                self._clients.remove(client)
        self.detail = f"{self._where}, {len(self._clients)} clients"

    def tick(self) -> None:
        """Nothing to do: clients are accepted with the next line."""

    def close(self) -> None:
        """Close all."""
        for client in (*self._clients, self._listener):
            client.close()

    def _accept(self, header: bytes) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            client.setblocking(False)
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            client.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
            client.send(header)
            self._clients.append(client)


class TcpTarget:
    """A connection to a server, made anew when it breaks."""

    def __init__(self, host: str, port: int) -> None:
        self._address = (host, port)
        self._socket: socket.socket | None = None
        self._ticks = RETRY_TICKS
        self._fresh = True
        self.detail = f"{host}:{port}"

    def send(self, header: bytes, line: bytes) -> None:
        """Send a line; lines are lost while nothing is connected."""
        if self._socket is None:
            raise ConnectionError(f"{self.detail} is not connected")
        try:
            self._socket.sendall(header + line if self._fresh else line)
            self._fresh = False
        except OSError:
            self.close()
            raise

    def tick(self) -> None:
        """Connect when it is time to try again."""
        self._ticks += 1
        if self._socket is not None or self._ticks < RETRY_TICKS:
            return
        self._ticks = 0
        try:
            self._socket = socket.create_connection(self._address, timeout=0.2)
            self._fresh = True
        except OSError:
            self._socket = None

    def close(self) -> None:
        """Close the connection."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None


class UdpTarget:
    """Datagrams, one line each, without header."""

    def __init__(self, host: str, port: int) -> None:
        self._address = (host, port)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.detail = f"{host}:{port}"

    def send(self, header: bytes, line: bytes) -> None:
        """Send a line."""
        del header
        self._socket.sendto(line, self._address)

    def tick(self) -> None:
        """Nothing to do."""

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


_OPEN: Final[dict[str, Callable[[str, int], Target]]] = {"tcp-listen": TcpListenTarget, "tcp": TcpTarget, "udp": UdpTarget}


def open_target(url: str) -> Target:
    """Return the target of a URL: file://PATH, tcp-listen://HOST:PORT, tcp://HOST:PORT, udp://HOST:PORT."""
    scheme, where, port = parse_target(url)
    return FileTarget(Path(where)) if scheme == "file" else _OPEN[scheme](where or "127.0.0.1", port)


def parse_target(url: str) -> tuple[str, str, int]:
    """Return (scheme, path or host, port) of a target's URL; SourceError says what is wrong with it."""
    scheme, found, rest = url.partition("://")
    if scheme == "file" and rest:
        return scheme, rest, 0
    if not found or scheme not in _OPEN:
        raise SourceError(f"{url!r}: unknown target; targets are file://, {', '.join(s + '://' for s in _OPEN)}")
    parts = urlsplit(url)
    try:
        port = parts.port
    except ValueError:
        port = None
    if not port:
        raise SourceError(f"{url!r}: needs host:port")
    return scheme, parts.hostname or "", port
