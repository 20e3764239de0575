"""Open ways out: a socket, a serial port, standard output, a caster's mount point; and what opens them. A sender's thread uses them."""

import os
import socket
from contextlib import suppress
from typing import Any, Final, Protocol

import serial

from rtkmesh_services.errors import SourceError
from rtkmesh_services.ntrip.connection import CasterConnection, has_news, open_push
from rtkmesh_services.ntrip.protocol import chunk
from rtkmesh_services.output.targets import TargetUrl
from rtkmesh_services.runtime.backoff import CASTER, LOCAL, Backoff
from rtkmesh_services.runtime.serial_device import find_port, open_port, read_port

CONNECT_S: Final = 5.0
SEND_S: Final = 10.0  # who takes nothing for so long is given up
SEND_BUFFER: Final = 65536  # what is in there can be dropped no more
READ_BYTES: Final = 65536
MAXIMUM_DATAGRAM: Final = 65507


class Outlet(Protocol):
    """An open way out. SourceError or OSError when it takes no more."""

    detail: str

    def write(self, data: bytes) -> None:
        """Send all of it."""
        ...

    def check(self) -> None:
        """Look whether the other side is still there; forget what it says."""
        ...

    def close(self) -> None:
        """Let go."""
        ...


class Opener(Protocol):
    """What opens one target again and again."""

    name: str
    backoff: Backoff
    has_preface: bool  # whether a header makes sense there

    def open(self) -> Outlet:
        """Return the open way; SourceError or OSError says why there is none."""
        ...


class SocketOutlet:
    """A connected TCP socket."""

    def __init__(self, connection: socket.socket, detail: str) -> None:
        self._socket, self.detail = connection, detail
        connection.settimeout(SEND_S)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)

    def write(self, data: bytes) -> None:
        """Send all of it; TimeoutError when the other side takes too little."""
        try:
            self._socket.sendall(data)
        except TimeoutError:
            raise TimeoutError(f"has taken nothing for {SEND_S:.0f} s") from None

    def check(self) -> None:
        """ConnectionError when the other side has closed."""
        while has_news(self._socket):
            if not self._socket.recv(READ_BYTES):
                raise ConnectionError("closed by the other side")

    def close(self) -> None:
        """Close the socket; a write that waits ends."""
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()


class TcpOpener:
    """Connects to a TCP server."""

    backoff, has_preface = LOCAL, True

    def __init__(self, url: TargetUrl) -> None:
        self._url, self.name = url, str(url)

    def open(self) -> Outlet:
        """Return a connection."""
        return SocketOutlet(socket.create_connection((self._url.host, self._url.port), timeout=CONNECT_S), self.name)


class UdpOutlet:
    """Datagrams, one of each text or frame; nobody has to be there."""

    def __init__(self, family: int, address: Any, detail: str) -> None:
        self._address, self.detail = address, detail
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)

    def write(self, data: bytes) -> None:
        """Send one datagram, or as many as it takes."""
        for begin in range(0, len(data), MAXIMUM_DATAGRAM):
            self._socket.sendto(data[begin : begin + MAXIMUM_DATAGRAM], self._address)

    def check(self) -> None:
        """Nobody has to be there."""

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class UdpOpener:
    """Finds out where datagrams go; broadcast addresses are allowed."""

    backoff, has_preface = LOCAL, False

    def __init__(self, url: TargetUrl) -> None:
        self._url, self.name = url, str(url)

    def open(self) -> Outlet:
        """Return a socket."""
        family, _, _, _, address = socket.getaddrinfo(self._url.host, self._url.port, type=socket.SOCK_DGRAM)[0]
        return UdpOutlet(family, address, self.name)


class SerialOutlet:
    """An open serial port, locked for us alone."""

    def __init__(self, port: "serial.Serial", detail: str) -> None:
        self._port, self.detail = port, detail

    def write(self, data: bytes) -> None:
        """Write all of it; an OSError when the line takes too little, or the device has gone."""
        self._port.write(data)

    def check(self) -> None:
        """SourceError when the device has gone; what it says is forgotten."""
        try:
            waiting = self._port.in_waiting
        except (serial.SerialException, OSError) as error:
            raise SourceError(f"{self.detail}: the device has gone (unplugged?)") from error
        if waiting:
            read_port(self._port, self.detail)

    def close(self) -> None:
        """Close the port."""
        self._port.close()


class SerialOpener:
    """Opens a serial port; its name is looked up anew each time."""

    backoff, has_preface = LOCAL, True

    def __init__(self, url: TargetUrl) -> None:
        self._url, self.name = url, str(url)

    def open(self) -> Outlet:
        """Return the open port."""
        path = find_port(self._url.path)
        return SerialOutlet(open_port(path, self._url.baud, SEND_S), f"{path} at {self._url.baud} baud")


class StandardOutput:
    """The process's standard output: it is open already, and stays so."""

    backoff, has_preface = LOCAL, True
    name = detail = "standard output"

    def open(self) -> Outlet:
        """Return itself."""
        return self

    def write(self, data: bytes) -> None:
        """Write all of it; waits for who reads it."""
        while data:
            data = data[os.write(1, data) :]

    def check(self) -> None:
        """It is seen at the next write."""

    def close(self) -> None:
        """It is the process's."""


class PushOutlet:
    """A connection that feeds a caster's mount point."""

    def __init__(self, connection: CasterConnection, version: int, detail: str) -> None:
        self._connection, self._version, self.detail = connection, version, detail
        connection.set_timeout(SEND_S)

    def write(self, data: bytes) -> None:
        """Send it as the version has it."""
        self._connection.write(chunk(data) if self._version == 2 else data)

    def check(self) -> None:
        """SourceError when the caster has closed."""
        if self._connection.has_news() and self._connection.read() == b"":
            raise SourceError(f"{self.detail}: closed by the caster")

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()


class PushOpener:
    """Connects to a caster as NTRIP server."""

    has_preface = True

    def __init__(self, url: TargetUrl, backoff: Backoff = CASTER) -> None:
        assert url.caster is not None, "a mount point is a caster's"
        self._url, self._address, self.backoff, self.name = url, url.caster, backoff, str(url)

    def open(self) -> Outlet:
        """Return a connection that the caster has accepted."""
        version = self._url.version
        return PushOutlet(open_push(self._address, version=version, tls=self._url.tls), version, self.name)
