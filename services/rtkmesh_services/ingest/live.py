"""The live sources of one ingest: a link and a decoder each, of which one is used (``Failover``). Used by the work loop alone."""

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from rtkmesh.codecs.messages import DecodingCounters, Frame, FramingCounters, Message
from rtkmesh.codecs.stream import StreamDecoder
from rtkmesh.gnss.ephemeris import GlonassBias, ReferenceStation
from rtkmesh_schemas.status import InputStatus
from rtkmesh_services.ingest.commands import ReceiverCommands
from rtkmesh_services.ingest.corrections import CorrectionQueue
from rtkmesh_services.ingest.failover import Failover
from rtkmesh_services.ingest.followed import FollowedIngest
from rtkmesh_services.ingest.links import Chunk, Link, LinkReport, LinkState, Sink
from rtkmesh_services.ingest.ntrip_source import FindPlace
from rtkmesh_services.ingest.replay import Simulation
from rtkmesh_services.ingest.urls import SourceUrl
from rtkmesh_services.runtime.bus import Bus
from rtkmesh_services.runtime.clock import Clock

NOT_OPEN: Final = "not open"
FIRST_FRAME_BYTES: Final = 4096
NO_FRAME_BYTES: Final = 32768  # four of the longest frames


class SimulatedLink:
    """A simulated receiver in place of a link."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation, self._stop = simulation, threading.Event()

    def start(self, after: "Link | None" = None) -> None:
        """Begin to send."""
        del after
        threading.Thread(target=self._simulation.run, args=(self._stop,), daemon=True, name="source").start()

    def stop(self, wait_s: float = 0.0) -> None:
        """End its thread; returns at once."""
        del wait_s
        self._stop.set()

    def write(self, data: bytes) -> bool:
        """Take nothing: a simulated receiver does not listen."""
        del data
        return False


@dataclass(slots=True)
class _Source:
    url: SourceUrl
    decoder: StreamDecoder
    link: Link | SimulatedLink | FollowedIngest | None = None
    last: Link | None = None
    state: str = NOT_OPEN
    detail: str = ""
    origin: str = ""
    bytes: int = 0
    unframed: int = 0  # bytes since the last whole frame
    heard_ns: int | None = None
    station: ReferenceStation | None = None
    bias: GlonassBias | None = None
    errors: int = field(default=0)


class LiveSources:
    """Opens, closes and decodes the sources of one ingest."""

    def __init__(
        self,
        urls: list[SourceUrl],
        new_decoder: Callable[[SourceUrl], StreamDecoder],
        sink: Sink,
        failover: Failover,
        find_place: FindPlace | None,
        clock: Clock,
        commands: ReceiverCommands,
        bus: Bus,
        corrections: CorrectionQueue | None = None,
    ) -> None:
        self._commands, self._corrections, self._bus = commands, corrections, bus
        self._new_decoder, self._sink, self._failover, self._find_place, self._clock = new_decoder, sink, failover, find_place, clock
        self._sources = [_Source(url, new_decoder(url)) for url in urls]

    @property
    def active(self) -> int:
        """The number of the source that is used."""
        return self._failover.active

    @property
    def decoder(self) -> StreamDecoder:
        """The decoder of the source that is used."""
        return self._sources[self.active].decoder

    @property
    def antenna(self) -> tuple[ReferenceStation | None, GlonassBias | None]:
        """What the source that is used has said of its antenna."""
        source = self._sources[self.active]
        return source.station, source.bias

    def start(self) -> None:
        """Open all sources that are to be open, close the others."""
        for number, source in enumerate(self._sources):
            if number < self._failover.running and source.link is None:
                source.link = self._link(number, source.url)
                source.link.start(source.last)
                source.last = None
            elif number >= self._failover.running and source.link is not None:
                self._close(source)

    def stop(self, wait_s: float = 0.0) -> None:
        """Close all; waits at most so long for stop commands."""
        for source in self._sources:
            self._close(source, wait_s)

    def write(self, data: bytes) -> bool:
        """Send bytes to the receiver of the source that is used; False when they cannot be sent."""
        link = self._sources[self.active].link
        return link is not None and link.write(data)

    def take(self, chunk: Chunk) -> tuple[list[tuple[Frame, list[Message]]], bool]:
        """Return the frames of a chunk with their messages if they are to be used, and whether the source has just been changed."""
        source = self._sources[chunk.source]
        if chunk.source >= self._failover.running:  # closed meanwhile
            return [], False
        source.bytes, source.heard_ns = source.bytes + len(chunk.data), chunk.mono_ns
        frames = source.decoder.feed(chunk.data)
        source.unframed = 0 if frames else source.unframed + len(chunk.data)
        switched = bool(frames) and self._failover.heard(chunk.source, chunk.mono_ns * 1e-9)
        if switched:
            self.start()
        if switched or len(self._sources) > 1:
            _remember(source, frames)
        return (frames if chunk.source == self.active else []), switched

    def silent(self, now_s: float) -> str:
        """Open one more source when none of the open ones brings anything; return which, or nothing."""
        if not self._failover.silent(now_s):
            return ""
        self.start()
        return str(self._sources[self._failover.running - 1].url)

    def moved(self, report: LinkReport) -> bool:
        """Return whether a report says that the source in use is another antenna now (another nearest mount point)."""
        source, origin = self._sources[report.source], report.detail.partition(" ")[0]
        if report.state is not LinkState.CONNECTED or source.origin == origin:
            return False
        moved, source.origin = bool(source.origin), origin
        if moved:
            source.decoder, source.station, source.bias = self._new_decoder(source.url), None, None
        return moved and report.source == self.active

    def report(self, report: LinkReport) -> bool:
        """Take what a link says; return whether that is news to tell."""
        source = self._sources[report.source]
        if report.source >= self._failover.running:  # closed meanwhile
            return False
        if source.state == LinkState.ERROR and report.state is LinkState.CONNECTING:
            return False  # keep showing why the last attempt failed
        source.errors += report.state is LinkState.ERROR
        news = (source.state, source.detail) != (report.state.value, report.detail)
        source.state, source.detail = report.state.value, report.detail
        return news

    def state(self, number: int) -> tuple[str, str]:
        """Return state and detail of a source."""
        return self._sources[number].state, self._sources[number].detail

    def complaint(self) -> str:
        """Return what is wrong with the bytes of the source in use, or nothing."""
        source = self._sources[self.active]
        if source.unframed < (NO_FRAME_BYTES if source.decoder.framing.frames else FIRST_FRAME_BYTES):
            return ""
        text = f"{source.detail}: {source.unframed // FIRST_FRAME_BYTES * FIRST_FRAME_BYTES >> 10} kB without a whole frame"
        if source.url.scheme != "serial":
            return f"{text}: no frame of a known protocol comes from there"
        hint = "" if source.url.options.get("baud") == "auto" else "; baud=auto finds it"
        return f"{text}: looks like the wrong baud rate{hint}"

    def statuses(self, now_ns: int) -> list[InputStatus]:
        """Return each source's status; that of the one in use first."""
        order = sorted(range(len(self._sources)), key=lambda number: (number != self.active, number))
        return [self._status(self._sources[number], now_ns) for number in order]

    def _link(self, number: int, url: SourceUrl) -> "Link | SimulatedLink | FollowedIngest":
        if url.scheme == "ingest":
            return FollowedIngest(url, self._bus, self._sink, number)
        if url.scheme == "sim":
            return SimulatedLink(Simulation(url, self._clock, self._sink, source=number))
        commands, corrections = (self._commands, self._corrections) if number == 0 else (None, None)
        return Link(url, self._sink, source=number, find_place=self._find_place, commands=commands, corrections=corrections)

    def _status(self, source: _Source, now_ns: int) -> InputStatus:
        framing, decoding = source.decoder.framing, source.decoder.decoding
        return InputStatus(
            name=source.url.scheme,
            state=source.state,
            detail=source.detail or str(source.url),
            messages=framing.frames.total(),
            bytes=source.bytes,
            age_s=None if source.heard_ns is None else (now_ns - source.heard_ns) * 1e-9,
            errors=framing.checksum_failures.total() + decoding.rejected.total(),
            counters=counters_of(framing, decoding),
        )

    def _close(self, source: _Source, wait_s: float = 0.0) -> None:
        if source.link is not None:
            source.link.stop(wait_s)
            source.last = source.link if isinstance(source.link, Link) else None
        source.link, source.state, source.detail = None, NOT_OPEN, ""


def counters_of(framing: FramingCounters, decoding: DecodingCounters) -> dict[str, int]:
    """Return whole frames by kind and what was rejected of them."""
    return {**framing.frames, **{f"rejected {name}": count for name, count in decoding.rejected.items()}}


def _remember(source: _Source, frames: list[tuple[Frame, list[Message]]]) -> None:
    """Keep what a source that is not used says of its antenna, for the moment when it is."""
    for _, messages in frames:
        for message in messages:
            if isinstance(message, ReferenceStation):
                source.station = message
            elif isinstance(message, GlonassBias):
                source.bias = message
