"""The streams of a solver: from bus samples to engine messages in stream order, and credit back to replays."""

from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from math import inf
from typing import Final

import numpy as np

from rtkmesh.gnss.epoch import SLIP, Epoch
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.session import EndOfStream as End
from rtkmesh.rtk.session import Input, Source
from rtkmesh_schemas.errors import DecodeError, VersionError
from rtkmesh_schemas.keys import END, EPH, IONO, OBS, REF
from rtkmesh_schemas.observation import (
    CREDIT_WINDOW,
    EndOfStream,
    EphemerisMessage,
    GlonassState,
    IonosphereMessage,
    Observation,
    ReferenceMessage,
    Time,
)
from rtkmesh_schemas.status import InputStatus
from rtkmesh_schemas.wire import decode
from rtkmesh_services.mapping.navigation import ephemeris_of, glonass_bias_of, klobuchar_of, station_of, wire_time
from rtkmesh_services.mapping.observation import epoch_of
from rtkmesh_services.runtime.bus import Sample
from rtkmesh_services.solver.sequencer import Sequencer

Numbered = Observation | EphemerisMessage | IonosphereMessage | ReferenceMessage | EndOfStream
TYPES: Final[dict[str, type[Numbered]]] = {
    "obs": Observation,
    "eph": EphemerisMessage,
    "iono": IonosphereMessage,
    "ref": ReferenceMessage,
    "end": EndOfStream,
}
STREAMS: Final = (OBS, EPH, IONO, REF, END)
CREDIT_EVERY: Final = 8  # messages
REPLAY_HOLD_S: Final = 10.0  # a replay is worth waiting for what a loaded machine recovers late
STRANGER_S: Final = 1.0  # a new start of an ingest is believed when the old one has left, or has been silent for so long


@dataclass(frozen=True, slots=True)
class Arrival:
    """An engine message as it came from a stream; ``received_mono_ns`` is when the receiver's bytes were read (0: unknown)."""

    source: Source
    message: Input
    received_mono_ns: int = 0


@dataclass(slots=True)
class InputStream:
    """One ingest as this solver takes it."""

    name: str
    source: Source
    replay: bool
    sequencer: Sequencer[Numbered] = field(init=False)
    messages: Counter[str] = field(default_factory=Counter[str])
    errors: int = 0
    bytes: int = 0
    glonass: int = 0  # ephemerides among the messages
    heard_s: float | None = None
    newest: GpsTime | None = None
    ended: bool = False
    strangers: int = 0
    fed: int = -1
    credited: int = -2
    _ours_s: float = -inf
    _epochs_of: str = ""
    _open: deque[tuple[int, GpsTime]] = field(default_factory=deque[tuple[int, GpsTime]])

    def __post_init__(self) -> None:
        self.sequencer = Sequencer(hold_s=REPLAY_HOLD_S if self.replay else 0.1, complete=self.replay)

    def take(self, sample: Sample, now_s: float) -> Iterator[Arrival]:
        """Take one sample and yield what is now in order; what cannot be decoded is counted."""
        kind = sample.key.split("/")[2]
        self.heard_s, self.bytes = now_s, self.bytes + len(sample.payload)
        try:
            message = decode(TYPES[kind], sample.payload, sample.encoding)
        except (DecodeError, VersionError):
            self.errors += 1
            return
        if self._of_another(message.start_id, now_s):
            self.strangers += 1
            return
        self.messages[kind] += 1
        self.glonass += isinstance(message, EphemerisMessage) and isinstance(message.orbit, GlonassState)
        anchors = isinstance(message, Observation | EndOfStream)
        joins = self._joins(message)
        for ordered in self.sequencer.take(message, message.start_id, message.sequence, now_s, anchors=anchors, joins=joins):
            yield from self._arrivals(ordered)

    def _joins(self, message: Numbered) -> bool:
        """Return whether a replay was under way before us: its first epoch is further on than our credit would have allowed."""
        first = self.replay and self._epochs_of == "" and isinstance(message, Observation)
        return first and message.sequence > max(self.credited, -1) + CREDIT_WINDOW

    def _of_another(self, start_id: str, now_s: float) -> bool:
        """Return whether a message is of a second process with this id, while the first one still speaks."""
        if start_id != self.sequencer.start_id and now_s - self._ours_s < STRANGER_S:
            return True
        self._ours_s = now_s
        return False

    def owner_left(self) -> None:
        """No process of this id is alive any more: the next one to speak is believed at once."""
        self._ours_s = -inf

    def overdue(self, now_s: float) -> Iterator[Arrival]:
        """Yield messages that were held for missing ones for too long."""
        for ordered in self.sequencer.overdue(now_s):
            yield from self._arrivals(ordered)

    def consumed(self, until: GpsTime | None) -> int:
        """Return the sequence up to which everything has been used, when all epochs up to ``until`` have."""
        while self._open and (until is None or self._open[0][1] <= until):
            self._open.popleft()
        return self._open[0][0] - 1 if self._open else self.fed

    def status(self, now_s: float) -> InputStatus:
        """Return how the stream is."""
        state = "ended" if self.ended else "waiting" if self.heard_s is None else "receiving"
        return InputStatus(
            name=self.name,
            state=state,
            detail=self.source.value,
            messages=self.messages.total(),
            bytes=self.bytes,
            age_s=None if self.heard_s is None else now_s - self.heard_s,
            lost=self.sequencer.lost,
            errors=self.errors,
            counters={**self.messages, **({"of_another_process": self.strangers} if self.strangers else {})},
        )

    def wanted(self, pending: GpsTime | None, reach_s: float) -> Time | None:
        """Return the time up to which this stream is needed for a rover epoch that waits for base epochs up to ``reach_s`` later."""
        return wire_time(pending + (reach_s + 1.0)) if pending is not None and self.source is Source.BASE else None

    def _after_restart(self, epoch: Epoch, start_id: str) -> Epoch:
        """Return the epoch, all slips if it is the first one of a restarted ingest: nobody watched the phases meanwhile."""
        restarted, self._epochs_of = self._epochs_of not in ("", start_id), start_id
        return (
            replace(epoch, flags=np.where(np.isfinite(epoch.phase_cyc), epoch.flags | SLIP, epoch.flags).astype(np.uint8))
            if restarted
            else epoch
        )

    def _arrivals(self, message: Numbered) -> Iterator[Arrival]:
        self.fed = max(self.fed, message.sequence) if message.start_id == self.sequencer.start_id else message.sequence
        try:
            for said in values_of(message):
                value = self._after_restart(said, message.start_id) if isinstance(said, Epoch) else said
                if isinstance(value, Epoch):
                    self._open.append((message.sequence, value.time))
                    self.newest = value.time
                self.ended = self.ended or isinstance(value, End)
                yield Arrival(self.source, value, message.received_mono_ns if isinstance(message, Observation) else 0)
        except DecodeError:
            self.errors += 1


def values_of(message: Numbered) -> Iterator[Input]:
    """Yield the engine's values of one wire message."""
    if isinstance(message, Observation):
        yield epoch_of(message)
    elif isinstance(message, EphemerisMessage):
        yield ephemeris_of(message)
    elif isinstance(message, IonosphereMessage):
        yield klobuchar_of(message)
    elif isinstance(message, ReferenceMessage):
        yield station_of(message)
        if (bias := glonass_bias_of(message)) is not None:
            yield bias
    else:
        yield End()
