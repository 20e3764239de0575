"""The satellites of an epoch, one row each, as sentences and status records name and order them."""

from collections.abc import Sequence
from math import cos, isfinite, nan, radians, sin, sqrt
from typing import Final, NamedTuple

from rtkmesh_schemas.solution import SatellitesMessage

USED: Final = 1 | 2  # bits of a row's state: its code or its phase was used
_MINIMUM: Final = 4  # satellites of a position
_SINGULAR: Final = 1e-12  # of a pivot against its diagonal


class Satellite(NamedTuple):
    """A satellite: RINEX id, direction (degrees), C/N0 of its first signal (dB-Hz, NaN: not tracked), whether the solution uses it."""

    id: str
    azimuth_deg: float
    elevation_deg: float
    cn0_dbhz: float
    used: bool

    @property
    def seen(self) -> bool:
        """Whether it is known to be above the horizon."""
        return self.elevation_deg > 0.0 and isfinite(self.azimuth_deg)


class Dops(NamedTuple):
    """Dilutions of precision of a geometry; NaN where there is none."""

    pdop: float = nan
    hdop: float = nan
    vdop: float = nan


def satellites_of(message: SatellitesMessage | None) -> list[Satellite]:
    """Return the satellites of a message in its order, each with the first of its signals."""
    if message is None:
        return []
    found: dict[str, Satellite] = {}
    rows = zip(message.satellite, message.azimuth_deg, message.elevation_deg, message.cn0_dbhz, message.state, strict=True)
    for id_, azimuth_deg, elevation_deg, cn0_dbhz, state in rows:
        used = bool(state & USED)
        known = found.get(id_)
        found[id_] = (
            Satellite(id_, azimuth_deg, elevation_deg, cn0_dbhz, used) if known is None else known._replace(used=known.used or used)
        )
    return list(found.values())


def dops(satellites: Sequence[Satellite]) -> Dops:
    """Return the dilutions of precision of satellites above the horizon: of (GᵀG)⁻¹, rows of G are east, north, up, 1."""
    rows = [_direction(one) for one in satellites if one.seen]
    if len(rows) < _MINIMUM:
        return Dops()
    normal = [[sum(row[i] * row[j] for row in rows) for j in range(4)] for i in range(4)]
    diagonal = _inverse_diagonal(normal)
    if diagonal is None:
        return Dops()
    east, north, up, _ = diagonal
    return Dops(sqrt(east + north + up), sqrt(east + north), sqrt(up))


def _direction(one: Satellite) -> tuple[float, float, float, float]:
    azimuth, elevation = radians(one.azimuth_deg), radians(one.elevation_deg)
    return cos(elevation) * sin(azimuth), cos(elevation) * cos(azimuth), sin(elevation), 1.0


def _inverse_diagonal(normal: list[list[float]]) -> list[float] | None:
    """Return the diagonal of the inverse of a positive definite matrix by Cholesky; None where it is not definite."""
    n = len(normal)
    lower = [[0.0] * n for _ in range(n)]
    for i in range(n):
        for j in range(i + 1):
            rest = normal[i][j] - sum(lower[i][k] * lower[j][k] for k in range(j))
            if i == j and not rest > _SINGULAR * normal[i][i]:
                return None
            lower[i][j] = sqrt(rest) if i == j else rest / lower[j][j]
    return [sum(value * value for value in _solved(lower, column)) for column in range(n)]


def _solved(lower: list[list[float]], column: int) -> list[float]:
    """Return the column of the inverse of a lower triangle."""
    values: list[float] = []
    for i in range(len(lower)):
        rest = (1.0 if i == column else 0.0) - sum(lower[i][k] * values[k] for k in range(i))
        values.append(rest / lower[i][i])
    return values
