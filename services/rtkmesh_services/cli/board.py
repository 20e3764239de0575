"""The newest word of every solver, attitude and process, gathered from the bus for people to look at."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, Generic, TypeVar

from rtkmesh_schemas.attitude import AttitudeMessage
from rtkmesh_schemas.errors import SchemaError
from rtkmesh_schemas.keys import ATT, SOL, STATUS, stream_of
from rtkmesh_schemas.solution import SolutionMessage
from rtkmesh_schemas.status import ServiceStatus
from rtkmesh_schemas.wire import Wire, decode
from rtkmesh_services.runtime.bus import Bus, Sample
from rtkmesh_services.runtime.inbox import Inbox
from rtkmesh_services.runtime.statistics import RollingQuantiles

_LONGEST_LATENCY_MS: Final = 600_000.0  # beyond it the receive time is of another host's clock
FIX: Final = 1

M = TypeVar("M", bound=Wire)


@dataclass(slots=True)
class Track(Generic[M]):
    """What one process has published on one stream."""

    newest: M
    received_ns: int
    count: int = 0
    fixes: int = 0
    latency_ms: RollingQuantiles = field(default_factory=RollingQuantiles)


class Board:
    """Subscribes, and takes what has come when asked to: callbacks of the bus only hand over."""

    def __init__(self) -> None:
        self._inbox = Inbox(capacity=8192)
        self.solutions: dict[str, Track[SolutionMessage]] = {}
        self.attitudes: dict[str, Track[AttitudeMessage]] = {}
        self.statuses: dict[str, tuple[ServiceStatus, int]] = {}
        self.refused = 0
        self.on_solution: Callable[[str, SolutionMessage, float], None] | None = None
        self.on_attitude: Callable[[str, AttitudeMessage, float], None] | None = None

    def attach(self, bus: Bus) -> None:
        """Subscribe to all solutions, attitudes and states."""
        for stream in (SOL, ATT, STATUS):
            bus.subscribe(stream.expression(), self._inbox.put, history=stream is STATUS)

    @property
    def lost(self) -> int:
        """How many messages came too fast to be taken."""
        return sum(self._inbox.dropped().values())

    def take(self, timeout_s: float) -> bool:
        """Wait for a message and take it; False when none came."""
        item = self._inbox.get(timeout_s)
        if not isinstance(item, Sample):
            return False
        found = stream_of(item.key)
        if found is not None:
            try:
                self._message(found[0].name, found[1], item)
            except SchemaError:
                self.refused += 1
        return True

    def _message(self, name: str, id_: str, sample: Sample) -> None:
        if name == STATUS.name:
            self.statuses[id_] = (decode(ServiceStatus, sample.payload, sample.encoding), sample.received_mono_ns)
        elif name == SOL.name:
            solution = decode(SolutionMessage, sample.payload, sample.encoding)
            latency_ms = _add(self.solutions, id_, solution, sample, solution.received_mono_ns, solution.status)
            if self.on_solution is not None:
                self.on_solution(id_, solution, latency_ms)
        elif name == ATT.name:
            attitude = decode(AttitudeMessage, sample.payload, sample.encoding)
            latency_ms = _add(self.attitudes, id_, attitude, sample, attitude.received_mono_ns, attitude.status)
            if self.on_attitude is not None:
                self.on_attitude(id_, attitude, latency_ms)


def _add(tracks: "dict[str, Track[M]]", id_: str, message: M, sample: Sample, begun_ns: int, status: int) -> float:
    """Add a message to its track; return its latency: from the last byte of the epoch to here, NaN if unknown."""
    track = tracks.get(id_)
    if track is None:
        track = tracks[id_] = Track(message, sample.received_mono_ns)
    track.newest, track.received_ns = message, sample.received_mono_ns
    track.count += 1
    track.fixes += status == FIX
    latency_ms = (sample.received_mono_ns - begun_ns) * 1e-6
    if not begun_ns or not 0.0 <= latency_ms < _LONGEST_LATENCY_MS:
        return float("nan")
    track.latency_ms.add(sample.received_mono_ns, latency_ms)
    return latency_ms
