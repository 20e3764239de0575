"""Another base for a solver that runs: what is known of it before it is used, what stays of the filter, and what the change does.

Velocity and acceleration of the rover do not depend on the base and stay as they are; its position stays as a beginning, with the sigma
of a new filter: bases stand in frames that differ by metres, and a position that is trusted would turn that into wrong integers.
Ambiguities, ionosphere, troposphere and GLONASS slope are differences to the old base and end with it, unless both streams prove to be
of one receiver.
"""

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from math import nan, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.gnss.ephemeris import GlonassBias, ReferenceStation
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.frames import enu_from_ecef, geodetic_from_ecef
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.solution import Solution, Status

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

_KEPT: Final = 32  # epochs of a base that is not used yet
_SAME_TIME_S: Final = 1e-4
_SAME_PHASE_CYC: Final = 2e-3  # streams of one receiver say the same phases, up to the resolution of their formats (MSM7: 2^-31 ms)
_SAME_PLACE_M: Final = 1e-3
_SHARED: Final = 8  # signals that must agree
_FRESH_S: Final = 2.0  # a base epoch that is not older may stand in for one that the rover waits for
_CADENCE_EPOCHS: Final = 3  # from them on it is known when the next one is due
COMPARED_S: Final = 10.0  # how long old and new base are compared when the new one has no fix
# What two bases may differ by beyond the sigmas: phase centres and formats; the troposphere by distance; of codes their multipath; age.
_FLOOR_FIX_M: Final = 0.015
_FLOOR_CODE_M: Final = 0.6
_PER_DISTANCE: Final = 1e-6
_PER_AGE_MPS: Final = 0.005
_CHI2_LIMIT: Final = 25.9  # three degrees of freedom, 1e-5
_RELATIVE: Final = (Status.FIX, Status.FLOAT, Status.DGPS)

Triple = tuple[float, float, float]
_UNKNOWN: Final[Triple] = (nan, nan, nan)


@dataclass(slots=True)
class Candidate:
    """A base that is listened to and not used yet. ``known``: its configured position, instead of what its stream says (ECEF, m)."""

    known: Triple | None = None
    epochs: deque[tuple[Epoch, float]] = field(default_factory=lambda: deque[tuple[Epoch, float]](maxlen=_KEPT))
    station: ReferenceStation | None = None
    bias: GlonassBias | None = None

    @property
    def position_ecef_m(self) -> Triple | None:
        """Where it stands, None while nobody has said so."""
        return self.known if self.known is not None or self.station is None else self.station.position_ecef_m

    def take(self, message: object, now_s: float) -> bool:
        """Take one message of its stream; return whether it was one that only a base's stream is asked for."""
        if isinstance(message, Epoch):
            self.epochs.append((message, now_s))
        elif isinstance(message, ReferenceStation):
            self.station = message
        elif isinstance(message, GlonassBias):
            self.bias = message
        else:
            return False
        return True

    def serves(self, waiting: GpsTime | None, tolerance_s: float, *, urgent: bool) -> bool:
        """Return whether it can take over now without costing an epoch.

        ``waiting``: the rover epoch that waits for the old base. It takes over when its cadence is known, or at once where it is
        ``urgent``: the old base is silent.
        """
        if len(self.epochs) < (1 if urgent else _CADENCE_EPOCHS):
            return False
        if waiting is None:
            return True
        return any(-tolerance_s <= waiting - epoch.time <= (_FRESH_S if urgent else tolerance_s) for epoch, _ in self.epochs)


@dataclass(frozen=True, slots=True)
class Jump:
    """What a change of the base did to the rover's position: solution with the new base minus that with the old, at one epoch.

    ``enu_m`` and ``sigma_enu_m`` (m, local frame of the rover) are NaN where one of the two gives no relative solution. ``significant``:
    more than the sigmas allow, so one of the base positions is wrong. ``decided``: both are fixed, or the comparison is over.
    """

    old_status: Status
    new_status: Status
    age_s: float
    enu_m: Triple = _UNKNOWN
    sigma_enu_m: Triple = _UNKNOWN
    significant: bool = False
    decided: bool = False
    same_antenna: bool = False


def same_antenna(old: Iterable[Epoch], new: Iterable[Epoch], places_ecef_m: Sequence[Triple | Vector | None]) -> bool:
    """Return whether two streams prove to be of one receiver: at their newest common epoch every phase that both have is the same.

    ``places_ecef_m``: old and new position of the base.
    """
    before, after = places_ecef_m
    if before is None or after is None or not float(np.abs(np.asarray(before) - np.asarray(after)).max()) <= _SAME_PLACE_M:
        return False
    theirs = list(new)
    for one in reversed(list(old)):
        for other in reversed(theirs):
            if abs(one.time - other.time) <= _SAME_TIME_S:
                return _same_phases(one, other)
    return False


def _same_phases(one: Epoch, other: Epoch) -> bool:
    said = {key: phase for key, phase in _phases(one) if phase == phase}
    gaps = [abs(phase - said[key]) for key, phase in _phases(other) if key in said and phase == phase]
    return len(gaps) >= _SHARED and max(gaps) <= _SAME_PHASE_CYC


def _phases(epoch: Epoch) -> Iterable[tuple[tuple[int, int], float]]:
    return zip(zip(epoch.satellite.tolist(), epoch.signal.tolist(), strict=True), epoch.phase_cyc.tolist(), strict=True)


def jump_between(old: Solution, new: Solution, *, over: bool) -> Jump:
    """Return the jump between the solutions of one rover epoch with the old and the new base; ``over``: this comparison is the last."""
    decided = over or (old.status is Status.FIX and new.status is Status.FIX)
    if old.status not in _RELATIVE or new.status not in _RELATIVE:
        return Jump(old.status, new.status, old.age_s, decided=over)
    lat_rad, lon_rad, _ = geodetic_from_ecef(new.position_ecef_m).tolist()
    turn = enu_from_ecef(lat_rad, lon_rad)
    jump, covariance = turn @ (new.position_ecef_m - old.position_ecef_m), turn @ _allowed_m2(old, new) @ turn.T
    return Jump(
        old.status,
        new.status,
        old.age_s,
        _triple(jump),
        _triple(np.sqrt(np.diag(covariance))),
        bool(jump @ np.linalg.solve(covariance, jump) > _CHI2_LIMIT),
        decided,
    )


def _allowed_m2(old: Solution, new: Solution) -> Matrix:
    """Return the covariance that an honest jump may have (ECEF)."""
    fixed = old.status is Status.FIX and new.status is Status.FIX
    lengths_m = sum(float(np.linalg.norm(one.baseline_ecef_m)) for one in (old, new))
    age_s = abs(old.age_s) + abs(new.age_s)
    parts = (_FLOOR_FIX_M if fixed else _FLOOR_CODE_M, _PER_DISTANCE * lengths_m, _PER_AGE_MPS * age_s)
    floor_m = sqrt(sum(part**2 for part in parts))
    return old.position_cov_ecef_m2 + new.position_cov_ecef_m2 + floor_m**2 * np.eye(3)


def _triple(vector: Vector) -> Triple:
    x, y, z = vector.tolist()
    return x, y, z
