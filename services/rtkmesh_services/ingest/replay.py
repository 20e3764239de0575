"""Threads that play recordings and simulated receivers into the work loop, paced by a clock and by their consumers."""

import threading
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rtkmesh.codecs.messages import Frame, Message
from rtkmesh.codecs.stream import StreamOptions
from rtkmesh.errors import OptionError
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.receiver_options import parse_receiver_options
from rtkmesh.gnss.time import GpsTime
from rtkmesh_schemas.config import IngestTable
from rtkmesh_services.errors import SourceError
from rtkmesh_services.ingest.credit import CreditGate
from rtkmesh_services.ingest.links import Chunk, LinkReport, LinkState
from rtkmesh_services.ingest.recording import Recording, open_recording
from rtkmesh_services.ingest.stream import is_numbered
from rtkmesh_services.ingest.urls import SourceUrl
from rtkmesh_services.runtime.clock import Clock

if TYPE_CHECKING:
    from rtkmesh.simulation.scenario import SimulatedStream

Put = Callable[[Any], bool]

DEFAULT_RATE_HZ: Final = 5.0


@dataclass(frozen=True, slots=True)
class Played:
    """A frame or a message of a recording on its way to the work loop."""

    item: Frame | Message
    mono_ns: int


@dataclass(frozen=True, slots=True)
class Ended:
    """The recording is at its end."""


class Pace:
    """Maps log time to the host's clock: ``speed`` times real time from ``start`` on, as fast as it goes before it or at speed 0."""

    def __init__(self, clock: Clock, speed: float, start: GpsTime | None) -> None:
        self._clock, self._speed, self._start = clock, speed, start
        self._anchor_ns = 0

    def wait(self, time: GpsTime, stopping: threading.Event) -> None:
        """Wait until the instant of an epoch."""
        if self._speed == 0.0 or (self._start is not None and time <= self._start):
            return
        if not self._anchor_ns:
            self._start = self._start or time
            self._anchor_ns = self._clock.mono_ns()
        assert self._start is not None, "set with the anchor"
        due_ns = self._anchor_ns + int((time - self._start) / self._speed * 1e9)
        stopping.wait(max(0.0, (due_ns - self._clock.mono_ns()) * 1e-9))


class Replay:
    """Plays one recording: waits for the consumers, then sends its messages in stream order."""

    def __init__(self, recording: Recording, pace: Pace, gate: CreditGate, clock: Clock, put: Put, first_sequence: int) -> None:
        self._recording, self._pace, self._gate, self._clock, self._put = recording, pace, gate, clock, put
        self._sequence = first_sequence

    def run(self, stopping: threading.Event) -> None:
        """Play it all; returns early when ``stopping`` is set."""
        self._put(LinkReport(LinkState.WAITING, "for consumers: " + ", ".join(self._gate.missing()) if self._gate.missing() else ""))
        if not self._gate.wait_ready(stopping):
            return
        self._put(LinkReport(LinkState.CONNECTED, str(self._recording.path)))
        try:
            for time, frame, messages in self._recording.timed_parts():
                if time is not None:
                    self._pace.wait(time, stopping)
                if not self._send_all(messages if frame is None else [frame, *messages], stopping, paced=time is not None):
                    return
        except SourceError as error:
            self._put(LinkReport(LinkState.ERROR, str(error)))
        self._put(Ended())

    def _send_all(self, items: Sequence[Frame | Message], stopping: threading.Event, *, paced: bool) -> bool:
        """Send a frame and its messages when the consumers and (unless ``paced``) the clock allow it; False when the process is to end."""
        for item in items:
            if isinstance(item, Epoch):
                if not self._gate.wait(self._sequence, item.time, stopping):
                    return False
                if not paced:
                    self._pace.wait(item.time, stopping)
            if not isinstance(item, Frame) and is_numbered(item):
                self._sequence += 1
            while not self._put(Played(item, self._clock.mono_ns())):
                if stopping.is_set():
                    return False
        return not stopping.is_set()


def stream_options(url: SourceUrl, table: IngestTable, near: GpsTime | None) -> StreamOptions:
    """Return what a source and its table say of decoding."""
    return StreamOptions(
        approximate_time=near, observations=table.observations, receiver=parse_receiver_options(table.options), antenna=url.antenna,
        accept=frozenset(table.filter.accept), reject=frozenset(table.filter.reject),
    )  # fmt: skip


def recording_of(url: SourceUrl, table: IngestTable) -> Recording:
    """Return the opened recording of a file URL; SourceError says what is wrong with it."""
    near = date_of(table.date)
    options = stream_options(url, table, near)
    return open_recording(Path(url.path), near, options=options, timed=url.word("times") == "yes" and url.speed > 0.0)


def date_of(text: str) -> GpsTime | None:
    """Return the GPS time of a date YYYY-MM-DD (noon), None for an empty text; SourceError for anything else."""
    if not text:
        return None
    try:
        year, month, day = (int(part) for part in text.split("-"))
        return GpsTime.from_calendar(year, month, day, 12)
    except ValueError:
        raise SourceError(f"date {text!r} is not YYYY-MM-DD") from None


def common_start(recordings: Iterable[Recording]) -> GpsTime | None:
    """Return the latest of the recordings' beginnings: from there on they are played in step. None without any."""
    return max((first for recording in recordings if (first := recording.begin()) is not None), default=None)


class Simulation:
    """A simulated receiver: sends the bytes of each epoch at its instant of the host's UTC clock."""

    def __init__(self, url: SourceUrl, clock: Clock, sink: Callable[[Chunk | LinkReport], None], source: int = 0) -> None:
        self._url, self._clock, self._sink, self._source = url, clock, sink, source

    def run(self, stopping: threading.Event) -> None:
        """Send until ``stopping`` is set."""
        try:
            simulated = open_simulation(self._url, gps_now(self._clock))
        except OptionError as error:
            self._sink(LinkReport(LinkState.ERROR, f"{self._url.path}: {error}", self._source))
            return
        self._sink(LinkReport(LinkState.CONNECTED, self._url.path, self._source))
        pause_s = 0.4 / self._url.number("rate", DEFAULT_RATE_HZ)
        for epoch in simulated.epochs():
            if stopping.wait(max(0.0, epoch.time - gps_now(self._clock))):
                return
            self._sink(Chunk(epoch.data, self._clock.mono_ns(), self._source))
            if stopping.wait(pause_s):  # this epoch is to be solved before the next one is computed
                return


def open_simulation(url: SourceUrl, start: GpsTime) -> "SimulatedStream":
    """Return the simulated receiver of a URL; OptionError for what the simulator does not have."""
    from rtkmesh.simulation.scenario import open_stream  # noqa: PLC0415  only simulated receivers need it

    scenario, _, stream = url.path.partition("/")
    return open_stream(scenario, stream, seed=int(url.number("seed", 1.0)), rate_hz=url.number("rate", DEFAULT_RATE_HZ), start=start)


def gps_now(clock: Clock) -> GpsTime:
    """Return the host's UTC clock as GPS time."""
    return GpsTime.from_utc(datetime.fromtimestamp(0, UTC) + timedelta(microseconds=clock.utc_ns() // 1000))
