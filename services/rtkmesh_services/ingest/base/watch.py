"""Whether a base still stands where it stood: new positions against the one that is believed."""

from dataclasses import dataclass
from math import hypot, sqrt
from typing import Final

import numpy as np

from rtkmesh.gnss.frames import enu_from_ecef_at
from rtkmesh_services.ingest.receivers.survey import Position

SIGMAS: Final = 3.0
CODE_SIGMA_M: Final = 2.5  # what a mean of code positions may be off, whatever a receiver says: its minutes err alike


@dataclass(frozen=True, slots=True)
class Move:
    """How far a position is from where the station stood (east, north, up, m), and how far it may be. ``kind``: jump, survey, fix."""

    kind: str
    since: str
    enu_m: Position
    distance_m: float
    limit_m: float

    @property
    def too_far(self) -> bool:
        """Whether that is no chance any more."""
        return self.distance_m > self.limit_m

    def __str__(self) -> str:
        east_m, north_m, up_m = self.enu_m
        vector = f"{east_m:+.2f} m east, {north_m:+.2f} m north, {up_m:+.2f} m up"
        return f"{self.distance_m:.2f} m from {self.since} ({vector}; the limit is {self.limit_m:.2f} m)"


def move(kind: str, since: str, before_ecef_m: Position, now_ecef_m: Position, limit_m: float) -> Move:
    """Return how far a position is from another one."""
    before = np.array(before_ecef_m)
    east_m, north_m, up_m = (enu_from_ecef_at(before) @ (np.array(now_ecef_m) - before)).tolist()
    return Move(kind, since, (east_m, north_m, up_m), hypot(east_m, north_m, up_m), limit_m)


def code_limit_m(saved_m: float, found_m: float, floor_m: float) -> float:
    """Return how far a position that was found by code may be from a saved one: three sigmas of both, in three dimensions."""
    return max(floor_m, SIGMAS * sqrt(saved_m**2 + max(found_m, CODE_SIGMA_M) ** 2))


class PositionWatch:
    """The position that is believed, and what was found against it. Nothing but ``believe`` changes what is believed."""

    def __init__(self, limit_m: float) -> None:
        self._limit_m = limit_m
        self.believed: Position | None = None
        self.since = ""
        self.moved: Move | None = None

    def believe(self, position_ecef_m: Position | None, since: str) -> None:
        """Take a position as the station's from now on."""
        self.believed, self.since, self.moved = position_ecef_m, since, None

    def sent(self, position_ecef_m: Position) -> Move | None:
        """Take a position that the receiver sends to rovers; return the move when that is news: too far off, or back again."""
        if self.believed is None:
            self.believe(position_ecef_m, "its first 1005/1006")
            return None
        return self._news(move("jump", self.since, self.believed, position_ecef_m, self._limit_m))

    def _news(self, made: Move) -> Move | None:
        was = self.moved
        if made.too_far and was is not None and np.allclose(was.enu_m, made.enu_m, atol=self._limit_m):
            return None
        self.moved = made if made.too_far else None
        return made if made.too_far or was is not None else None
