"""How good a base station is for a rover: one number from 0 to 1, out of what its ingest says of it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import dist
from typing import Any, Final

from rtkmesh_schemas.status import InputStatus, ServiceStatus, State, StreamStatus

_FRESH_S: Final = 2.0  # an epoch that is not older is as good as new
_USELESS_S: Final = 6.0
_FULL_RATE_HZ: Final = 0.95
_ENOUGH_SATELLITES: Final = 12
_TOO_FEW_SATELLITES: Final = 4
_FULL_CN0_DBHZ: Final = 42.0
_WORST_CN0_DBHZ: Final = 25.0
# Integers are found at once up to some kilometres; the ionosphere (1 ppm and more) makes that slow beyond twenty and rare beyond a hundred.
_NEAR_M: Final = 5e3
_FAR_M: Final = 1e5
_AT_FAR: Final = 0.2
_UNPLACED: Final = 0.1  # no position: it cannot be used until it says one
_WORST_ERROR_SHARE: Final = 0.2
_RECEIVING: Final = (State.RUNNING, State.DEGRADED, State.STALE)


@dataclass(frozen=True, slots=True)
class Score:
    """``value`` is the product of the parts, each from 0 to 1; ``weakest`` is the part that costs most."""

    value: float
    parts: Mapping[str, float] = field(default_factory=dict[str, float])
    distance_m: float | None = None

    @property
    def weakest(self) -> str:
        """The part that costs most, nothing where all are full."""
        name = min(self.parts, key=lambda part: self.parts[part], default="")
        return name if name and self.parts[name] < 0.995 else ""

    def words(self) -> dict[str, Any]:
        """Return it as plain values."""
        parts = {name: round(part, 2) for name, part in self.parts.items()}
        distance_m = None if self.distance_m is None else round(self.distance_m)
        return {"score": round(self.value, 3), "parts": parts, "weakest": self.weakest, "distance_m": distance_m}


NOTHING: Final = Score(0.0)


def score(status: ServiceStatus | None, status_age_s: float, rover_ecef_m: Sequence[float] | None = None) -> Score:
    """Return the score of the base whose ingest said ``status`` so many seconds ago; ``rover_ecef_m``: where the rover is, if known."""
    source = next(iter(status.inputs), None) if status is not None and status.state in _RECEIVING else None
    stream = None if source is None else source.stream
    if source is None or stream is None or stream.epoch_age_s is None:
        return NOTHING
    distance_m = _distance_m(stream, rover_ecef_m)
    parts = {
        "age": _falling(stream.epoch_age_s + status_age_s, _FRESH_S, _USELESS_S),
        "rate": _rate(stream),
        "satellites": _rising(sum(stream.satellites.values()), _TOO_FEW_SATELLITES, _ENOUGH_SATELLITES),
        "cn0": _cn0(stream),
        "position": 1.0 if stream.reference is not None else _UNPLACED,
        "distance": 1.0 if distance_m is None else 1.0 - (1.0 - _AT_FAR) * _rising(distance_m, _NEAR_M, _FAR_M),
        "errors": _errors(source, stream),
    }
    value = 1.0
    for part in parts.values():
        value *= part
    return Score(value, parts, distance_m)


def _rising(value: float, none: float, full: float) -> float:
    return min(1.0, max(0.0, (value - none) / (full - none)))


def _falling(value: float, full: float, none: float) -> float:
    return 1.0 - _rising(value, full, none)


def _rate(stream: StreamStatus) -> float:
    """Return 1 from one epoch a second on; a base that has just begun has no rate yet."""
    return 1.0 if stream.epochs < 3 else 0.5 + 0.5 * _rising(stream.epochs_per_s, 0.0, _FULL_RATE_HZ)


def _cn0(stream: StreamStatus) -> float:
    """Return how strong the signals are, by the strongest band's mean; streams that say no C/N0 are believed."""
    means = [band.mean for band in stream.cn0_dbhz.values()]
    return 0.3 + 0.7 * _rising(max(means), _WORST_CN0_DBHZ, _FULL_CN0_DBHZ) if means else 1.0


def _errors(source: InputStatus, stream: StreamStatus) -> float:
    failed = sum(stream.checksum_failures.values()) + source.lost
    share = failed / max(1, failed + source.messages)
    return _falling(share, 0.0, _WORST_ERROR_SHARE)


def _distance_m(stream: StreamStatus, rover_ecef_m: Sequence[float] | None) -> float | None:
    if rover_ecef_m is None or stream.reference is None:
        return None
    return dist(stream.reference.position_ecef_m, rover_ecef_m)
