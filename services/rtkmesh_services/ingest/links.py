"""Byte sources: one reader thread each, that comes back by itself and says what is wrong when it doesn't.

A link hands chunks of bytes to its sink, with the monotonic instant of reading, and never decodes. Opening is retried with
back-off for as long as the process runs.
"""

import os
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from queue import Empty, Full, Queue
from typing import Final, Protocol

import serial

from rtkmesh_services.errors import SourceError
from rtkmesh_services.ingest.urls import SourceUrl

READ_BYTES: Final = 65536
BACKOFF_FIRST_S: Final = 0.1
BACKOFF_LAST_S: Final = 0.5  # a restarted server shall be back within the second
POLL_S: Final = 0.25  # how soon a blocked reader notices that it shall stop
WRITE_QUEUE: Final = 256


class LinkState(StrEnum):
    """What a link is doing."""

    CONNECTING = "connecting"
    WAITING = "waiting for data"
    CONNECTED = "connected"
    ERROR = "error"
    ENDED = "ended"


@dataclass(frozen=True, slots=True)
class Chunk:
    """Bytes as they came from a receiver."""

    data: bytes
    mono_ns: int


@dataclass(frozen=True, slots=True)
class LinkReport:
    """A change of a link's state."""

    state: LinkState
    detail: str = ""


class SilentError(SourceError):
    """A connection that brings nothing is made anew."""


Sink = Callable[[Chunk | LinkReport], None]


class Wire(Protocol):
    """An open connection."""

    def read(self) -> bytes | None:
        """Return new bytes, b"" when the peer has closed, None when nothing came for a while."""
        ...

    def write(self, data: bytes) -> None:
        """Send bytes to the receiver."""
        ...

    def close(self) -> None:
        """Let go."""
        ...


class SocketWire:
    """A connected TCP socket; silence beyond ``timeout_s`` counts as closed."""

    def __init__(self, connection: socket.socket, timeout_s: float) -> None:
        self._socket, self._timeout_s = connection, timeout_s
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

    def __init__(self, bound: socket.socket) -> None:
        self._socket = bound
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


class SerialWire:
    """An open serial port, locked for us alone."""

    def __init__(self, path: str, baud: int) -> None:
        try:
            self._port = serial.Serial(path, baud, timeout=POLL_S, write_timeout=2.0, exclusive=True)
        except (serial.SerialException, ValueError) as error:
            number = getattr(error, "errno", None)
            raise SourceError(f"{path}: {os.strerror(number) if number else error}") from error

    def read(self) -> bytes | None:
        """Return what is there, waiting for the first byte."""
        data = self._port.read(max(1, min(self._port.in_waiting, READ_BYTES)))
        return bytes(data) or None

    def write(self, data: bytes) -> None:
        """Send bytes to the receiver."""
        try:
            self._port.write(data)
        except TypeError as error:  # pyserial's way of saying that the reader has closed the port meanwhile
            raise ConnectionError("the port was closed") from error

    def close(self) -> None:
        """Close the port."""
        self._port.close()


class Link:
    """A source of live bytes: connects, reads, writes and comes back, in threads of its own."""

    def __init__(self, url: SourceUrl, sink: Sink) -> None:
        self._url, self._sink = url, sink
        self._stop = threading.Event()
        self._wire: Wire | None = None
        self._listener: socket.socket | None = None
        self._writes: Queue[bytes] = Queue(WRITE_QUEUE)
        self._threads = [
            threading.Thread(target=target, daemon=True, name=f"link-{target.__name__}") for target in (self._read_loop, self._write_loop)
        ]

    def start(self) -> None:
        """Begin to connect."""
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """End both threads; returns at once."""
        self._stop.set()

    def write(self, data: bytes) -> bool:
        """Queue bytes for the receiver; False (and nothing queued) when the queue is full or nothing is connected."""
        if self._wire is None:
            return False
        try:
            self._writes.put_nowait(data)
        except Full:
            return False
        return True

    def _read_loop(self) -> None:
        backoff_s = BACKOFF_FIRST_S
        while not self._stop.is_set():
            try:
                self._sink(LinkReport(LinkState.CONNECTING, self._where()))
                if self._serve(self._open()):
                    backoff_s = BACKOFF_FIRST_S
            except SilentError:
                pass  # no fault that can be named: the ingest tells the silence
            except SourceError as error:
                self._sink(LinkReport(LinkState.ERROR, str(error)))
            except OSError as error:
                self._sink(LinkReport(LinkState.ERROR, f"{self._where()}: {error.strerror or error}"))
            self._stop.wait(backoff_s)
            backoff_s = min(BACKOFF_LAST_S, 2.0 * backoff_s)
        if self._listener is not None:
            self._listener.close()

    def _serve(self, wire: Wire | None) -> bool:
        """Read until the peer closes; return whether any data came."""
        if wire is None:
            return True
        self._wire = wire
        self._sink(LinkReport(LinkState.WAITING, self._where()))
        heard = False
        try:
            while not self._stop.is_set():
                data = wire.read()
                if data == b"":
                    self._sink(LinkReport(LinkState.ERROR, f"{self._where()}: closed by the other side"))
                    break
                if data:
                    self._sink(Chunk(data, time.monotonic_ns()))
                    if not heard:
                        heard = True
                        self._sink(LinkReport(LinkState.CONNECTED, self._where()))
        finally:
            self._wire = None
            wire.close()
        return heard

    def _open(self) -> Wire | None:
        url = self._url
        if url.scheme == "serial":
            return SerialWire(url.path, int(url.number("baud", 115200)))
        if url.scheme == "udp":
            bound = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            bound.bind((url.host or "127.0.0.1", url.port))
            return UdpWire(bound)
        if url.scheme == "tcp":
            return SocketWire(socket.create_connection((url.host, url.port), timeout=5.0), url.number("timeout", 10.0))
        return self._accept()

    def _accept(self) -> Wire | None:
        """Wait for a receiver to connect to us; None when it shall stop."""
        if self._listener is None:
            self._listener = socket.create_server((self._url.host or "127.0.0.1", self._url.port), reuse_port=False)
            self._listener.settimeout(POLL_S)
        while not self._stop.is_set():
            try:
                connection, _ = self._listener.accept()
            except TimeoutError:
                continue
            return SocketWire(connection, self._url.number("timeout", 10.0))
        return None

    def _write_loop(self) -> None:
        while not self._stop.is_set():
            try:
                data = self._writes.get(timeout=POLL_S)
            except Empty:
                continue
            wire = self._wire
            if wire is None:
                continue
            try:
                wire.write(data)
            except (OSError, serial.SerialException) as error:
                self._sink(LinkReport(LinkState.ERROR, f"writing: {error}"))

    def _where(self) -> str:
        return self._url.path if self._url.scheme == "serial" else f"{self._url.scheme}://{self._url.host}:{self._url.port}"
