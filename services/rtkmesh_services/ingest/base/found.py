"""Positions of a base station as they were found, and as they are saved."""

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Final

from rtkmesh.gnss.ephemeris import ReferenceStation
from rtkmesh_schemas.base import BasePosition
from rtkmesh_services.ingest.receivers.survey import Position

UNKNOWN_ACCURACY_M: Final = 10.0  # of a position that a receiver sends and says nothing about


@dataclass(frozen=True, slots=True)
class Found:
    """A position with its accuracy (one sigma, 3D, m) and where it is from."""

    position_ecef_m: Position
    accuracy_m: float
    source: str
    duration_s: float = 0.0
    observations: int = 0

    def saved_as(
        self,
        name: str,
        utc_ns: int,
        by: str,
        station: ReferenceStation,
        *,
        datum: str = "",
        antenna: str = "",
        height_m: float | None = None,
    ) -> BasePosition:
        """Return the position as it is to be saved, with what the receiver says of itself and its antenna."""
        return BasePosition(
            name=name,
            position_ecef_m=self.position_ecef_m,
            accuracy_m=self.accuracy_m,
            source=self.source,
            saved_utc=datetime.fromtimestamp(utc_ns * 1e-9, UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
            datum=datum,
            duration_s=self.duration_s,
            observations=self.observations,
            antenna=antenna or station.antenna,
            antenna_height_m=station.antenna_height_m if height_m is None else height_m,
            receiver=station.receiver,
            saved_by=by,
        )


def found_of(position: BasePosition) -> Found:
    """Return a saved position as one that is known."""
    return Found(position.position_ecef_m, position.accuracy_m, position.source, position.duration_s, position.observations)


def since(position: BasePosition) -> str:
    """Return in words where a position is from."""
    return f"the saved position {position.name!r} of {position.saved_utc}" if position.name else "the configured position"


def distance_m(one: Position, other: Position) -> float:
    """Return how far two positions are from one another."""
    return sum((a - b) ** 2 for a, b in zip(one, other, strict=True)) ** 0.5
