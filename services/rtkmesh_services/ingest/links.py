"""Byte sources: one reader thread each, that comes back by itself and says what is wrong when it doesn't.

A link hands chunks of bytes to its sink, with the monotonic instant of reading, and never decodes. Opening is retried with
back-off for as long as the process runs.
"""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from rtkmesh_services.errors import SourceError
from rtkmesh_services.ingest.commands import ReceiverCommands
from rtkmesh_services.ingest.corrections import CorrectionQueue
from rtkmesh_services.ingest.ntrip_source import FindPlace, NtripSource
from rtkmesh_services.ingest.serial_ports import SerialPort
from rtkmesh_services.ingest.urls import SourceUrl
from rtkmesh_services.ingest.wires import EndedError, Opener, ReopenError, SilentError, Stdin, TcpClient, TcpServer, UdpSocket, Wire
from rtkmesh_services.ingest.writer import Writer
from rtkmesh_services.runtime.backoff import Backoff, Pauses

LET_GO_S: Final = 1.5


class LinkState(StrEnum):
    """What a link is doing."""

    CONNECTING = "connecting"
    WAITING = "waiting for data"
    CONNECTED = "connected"
    ERROR = "error"
    ENDED = "ended"


@dataclass(frozen=True, slots=True)
class Chunk:
    """Bytes as they came from a receiver. ``source`` counts the sources of one ingest: 0 is the first choice."""

    data: bytes
    mono_ns: int
    source: int = 0


@dataclass(frozen=True, slots=True)
class LinkReport:
    """A change of a link's state. ``retry_s``: the pause before the next attempt."""

    state: LinkState
    detail: str = ""
    source: int = 0
    retry_s: float = 0.0


Sink = Callable[[Chunk | LinkReport], None]


class Link:
    """A source of live bytes: connects, reads, writes and comes back, in threads of its own."""

    def __init__(
        self,
        url: SourceUrl,
        sink: Sink,
        *,
        source: int = 0,
        find_place: FindPlace | None = None,
        commands: ReceiverCommands | None = None,
        corrections: CorrectionQueue | None = None,
        backoff: Backoff | None = None,
    ) -> None:
        self._url, self._sink, self._source = url, sink, source
        self._opener = self._opener_of(url, find_place)
        self._pauses = Pauses(backoff or self._opener.backoff)
        self._stop = threading.Event()
        self._after: Link | None = None
        self._heard_s = 0.0
        self._farewell = bool(commands and commands.stop)
        self._writer = Writer(commands or ReceiverCommands(), lambda text: self._say(LinkState.ERROR, text), corrections)
        self._threads = [
            threading.Thread(target=self._read_loop, daemon=True, name="link-read"),
            threading.Thread(target=self._writer.run, args=(self._stop,), daemon=True, name="link-write"),
        ]

    def start(self, after: "Link | None" = None) -> None:
        """Begin to connect, ``after`` another link to the same receiver has let go of it."""
        self._after = after
        for thread in self._threads:
            thread.start()

    def stop(self, wait_s: float = 0.0) -> None:
        """End both threads; returns at once, or when the receiver was told its stop commands, but within ``wait_s``."""
        self._stop.set()
        if self._farewell and wait_s > 0.0 and self._threads[0].is_alive():
            self._threads[0].join(wait_s)

    def write(self, data: bytes) -> bool:
        """Queue bytes for the receiver; False (and nothing queued) when the queue is full or nothing is connected."""
        return self._writer.put(data)

    def _read_loop(self) -> None:
        if self._after is not None and self._after._threads[0].is_alive():  # noqa: SLF001  one of us
            self._after._threads[0].join(LET_GO_S)  # noqa: SLF001
        self._after = None
        while not self._stop.is_set():
            try:
                error = self._attempt()
            except EndedError as end:
                self._say(LinkState.ENDED, str(end))
                break
            pause_s = self._pauses.after(self._heard_s, error)
            if error is not None:
                text = str(error) if isinstance(error, SourceError) else f"{self._url}: {error.strerror or error}"
                self._say(LinkState.ERROR, text, pause_s)
            self._stop.wait(pause_s)
        self._opener.close()

    def _attempt(self) -> SourceError | OSError | None:
        """Open and read until the connection ends; return why, where that is a fault that can be named."""
        self._heard_s = 0.0
        try:
            self._say(LinkState.CONNECTING, str(self._url))
            wire = self._opener.open(self._stop)
            if wire is not None:
                self._serve(wire)
        except ReopenError:
            self._heard_s = max(self._heard_s, self._opener.backoff.good_s)
        except SilentError:
            pass  # no fault that can be named: the ingest tells the silence
        except EndedError:
            raise
        except (SourceError, OSError) as error:
            return error
        return None

    def _serve(self, wire: Wire) -> None:
        """Read until the peer closes; ``_heard_s`` is for how long data came."""
        self._writer.opened(wire)
        self._say(LinkState.WAITING, wire.detail)
        first_s = 0.0
        try:
            while not self._stop.is_set():
                data = wire.read()
                if data == b"":
                    raise SourceError(f"{wire.detail}: closed by the other side")
                if not data:
                    continue
                now_ns = time.monotonic_ns()
                if not first_s:
                    first_s = now_ns * 1e-9
                    self._say(LinkState.CONNECTED, wire.detail)
                self._sink(Chunk(data, now_ns, self._source))
                self._heard_s = max(1e-6, now_ns * 1e-9 - first_s)
        finally:
            self._writer.closing(wire, leaving=self._stop.is_set())
            wire.close()

    def _opener_of(self, url: SourceUrl, find_place: FindPlace | None) -> Opener:
        if url.caster is not None:
            return NtripSource(url, find_place, lambda text: self._say(LinkState.WAITING, text))
        if url.scheme == "serial":
            return SerialPort(url, lambda text: self._say(LinkState.WAITING, text))
        if url.scheme == "stdin":
            return Stdin()
        return {"tcp": TcpClient, "tcp-listen": TcpServer, "udp": UdpSocket}[url.scheme](url)

    def _say(self, state: LinkState, detail: str, retry_s: float = 0.0) -> None:
        if not self._stop.is_set():  # one that was stopped while it connected says nothing more
            self._sink(LinkReport(state, detail, self._source, retry_s))
