"""Open connections to receivers, and what opens them: TCP, UDP. Serial ports and casters have files of their own."""

import os
import select
import socket
import threading
import time
from typing import Final, Protocol

from rtkmesh_services.errors import SourceError
from rtkmesh_services.ingest.urls import SourceUrl
from rtkmesh_services.runtime.backoff import LOCAL, Backoff

READ_BYTES: Final = 65536
POLL_S: Final = 0.25  # how soon a blocked reader notices that it shall stop
CONNECT_S: Final = 5.0
TIMEOUT_S: Final = 10.0


class SilentError(SourceError):
    """A connection that brings nothing is made anew."""


class EndedError(SourceError):
    """A source has come to its end and does not come back."""


class ReopenError(SourceError):
    """A connection is to be made anew for a good reason of ours."""


class Wire(Protocol):
    """An open connection. ``detail`` says with whom, ``bytes_per_s`` what it carries (0: not known)."""

    detail: str

    @property
    def bytes_per_s(self) -> float:
        """What the connection carries towards the receiver; 0: not known."""
        ...

    def read(self) -> bytes | None:
        """Return new bytes, b"" when the peer has closed, None when nothing came for a while."""
        ...

    def write(self, data: bytes) -> None:
        """Send bytes to the receiver; ConnectionError where nothing can be sent."""
        ...

    def close(self) -> None:
        """Let go."""
        ...


class Opener(Protocol):
    """What knows how to open one source. Used by one thread."""

    backoff: Backoff

    def open(self, stopping: threading.Event) -> Wire | None:
        """Return an open connection, None when ``stopping`` was set meanwhile; SourceError or OSError says why there is none."""
        ...

    def close(self) -> None:
        """Let go of what is kept between connections."""
        ...


class SocketWire:
    """A connected TCP socket; silence beyond ``timeout_s`` counts as closed."""

    bytes_per_s = 0.0

    def __init__(self, connection: socket.socket, timeout_s: float, detail: str) -> None:
        self._socket, self._timeout_s, self.detail = connection, timeout_s, detail
        self._heard_s = time.monotonic()
        connection.settimeout(POLL_S)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def read(self) -> bytes | None:
        """Return new bytes, b"" when closed or silent for too long, None when nothing came."""
        try:
            data = self._socket.recv(READ_BYTES)
        except TimeoutError:
            if time.monotonic() - self._heard_s > self._timeout_s:
                raise SilentError(f"no data for {self._timeout_s:.0f} s") from None
            return None
        self._heard_s = time.monotonic()
        return data

    def write(self, data: bytes) -> None:
        """Send bytes."""
        self._socket.sendall(data)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class UdpWire:
    """A bound UDP socket; every datagram is a chunk."""

    bytes_per_s = 0.0

    def __init__(self, bound: socket.socket, detail: str) -> None:
        self._socket, self.detail = bound, detail
        self._peer: tuple[str, int] | None = None
        bound.settimeout(POLL_S)

    def read(self) -> bytes | None:
        """Return a datagram or None."""
        try:
            data, self._peer = self._socket.recvfrom(READ_BYTES)
        except TimeoutError:
            return None
        return data or None

    def write(self, data: bytes) -> None:
        """Send to the peer heard last."""
        if self._peer is not None:
            self._socket.sendto(data, self._peer)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class StdinWire:
    """Standard input; corrections go nowhere."""

    bytes_per_s = 0.0
    detail = "standard input"

    def read(self) -> bytes | None:
        """Return new bytes, None when nothing came for a while; EndedError at the end."""
        readable, _, _ = select.select([0], [], [], POLL_S)
        data = os.read(0, READ_BYTES) if readable else None
        if data == b"":
            raise EndedError("standard input is at its end (`rtkmesh up` gives it to nobody: say `rtkmesh run ingest`)")
        return data

    def write(self, data: bytes) -> None:
        """Refuse: there is nobody behind a pipe."""
        del data
        raise ConnectionError("standard input takes no data")

    def close(self) -> None:
        """It is the process's."""


class Stdin:
    """Opens standard input."""

    backoff = LOCAL

    def open(self, stopping: threading.Event) -> Wire | None:
        """Return standard input."""
        del stopping
        return StdinWire()

    def close(self) -> None:
        """Nothing is kept."""


class TcpClient:
    """Connects to a TCP server."""

    backoff = LOCAL

    def __init__(self, url: SourceUrl) -> None:
        self._url = url

    def open(self, stopping: threading.Event) -> Wire | None:
        """Return a connection."""
        del stopping
        connection = socket.create_connection((self._url.host, self._url.port), timeout=CONNECT_S)
        return SocketWire(connection, self._url.number("timeout", TIMEOUT_S), str(self._url))

    def close(self) -> None:
        """Nothing is kept."""


class TcpServer:
    """Lets receivers connect to us, one after the other."""

    backoff = LOCAL

    def __init__(self, url: SourceUrl) -> None:
        self._url = url
        self._listener: socket.socket | None = None

    def open(self, stopping: threading.Event) -> Wire | None:
        """Wait for a receiver."""
        if self._listener is None:
            self._listener = socket.create_server((self._url.host or "127.0.0.1", self._url.port), reuse_port=False)
            self._listener.settimeout(POLL_S)
        while not stopping.is_set():
            try:
                connection, _ = self._listener.accept()
            except TimeoutError:
                continue
            return SocketWire(connection, self._url.number("timeout", TIMEOUT_S), str(self._url))
        return None

    def close(self) -> None:
        """Listen no more."""
        if self._listener is not None:
            self._listener.close()


class UdpSocket:
    """Takes datagrams."""

    backoff = LOCAL

    def __init__(self, url: SourceUrl) -> None:
        self._url = url

    def open(self, stopping: threading.Event) -> Wire | None:
        """Return a bound socket."""
        del stopping
        bound = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            bound.bind((self._url.host or "127.0.0.1", self._url.port))
        except OSError:
            bound.close()
            raise
        return UdpWire(bound, str(self._url))

    def close(self) -> None:
        """Nothing is kept."""
