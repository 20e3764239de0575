"""Records of satellites in RTKLIB's solution status: $SAT and $ION."""

from collections.abc import Iterator, Sequence
from math import asin, cos, isfinite, nan, radians
from typing import Final, NamedTuple

from rtkmesh.gnss.constants import WGS84_A_M
from rtkmesh_schemas.solution import SatellitesMessage
from rtkmesh_services.texts.options import Dialect
from rtkmesh_services.texts.sky import USED

_IONOSPHERE_M: Final = 350e3  # height of RTKLIB's layer (ionmapf)
_PHASE_USED, _FIXED, _SLIPPED, _HALF_CYCLE = 2, 4, 8, 32  # bits of a row's state
_SBAS_PRN: Final = 100  # of RINEX number 0: RTKLIB calls SBAS satellites by their PRN

# RINEX band -> number of the frequency in $SAT, from 1 (RTKLIB 2.4.3: L1, L2, L5 and what stands in for them)
_FREQUENCIES: Final = {
    "G": {"1": 1, "2": 2, "5": 3}, "R": {"1": 1, "4": 1, "2": 2, "6": 2, "3": 3}, "E": {"1": 1, "7": 2, "5": 3, "6": 4, "8": 5},
    "C": {"1": 1, "2": 1, "7": 2, "5": 3, "6": 4, "8": 5}, "J": {"1": 1, "2": 2, "5": 3, "6": 4}, "S": {"1": 1, "5": 2},
    "I": {"5": 1, "9": 2},
}  # fmt: skip


class Row(NamedTuple):
    """One signal of a satellite in the solution; unknown is NaN."""

    id: str
    frequency: int
    state: int
    azimuth_deg: float
    elevation_deg: float
    cn0_dbhz: float
    code_m: float
    phase_m: float
    ambiguity_cyc: float
    slips: int
    variance_cyc2: float
    lock: float
    rejects: float
    ionosphere_m: float


def rows_of(message: SatellitesMessage) -> list[Row]:
    """Return the signals of those satellites that the solution uses; of two signals of one frequency the first."""
    used = {id_ for id_, state in zip(message.satellite, message.state, strict=True) if state & USED}
    return list({(row.id, row.frequency): row for row in reversed(list(_rows(message))) if row.id in used and row.frequency}.values())[::-1]


def satellite(row: Row, dialect: Dialect) -> str:
    """Return what follows the time in $SAT: 2.4.2 ends with the rejects, demo5 goes on with the ambiguity."""
    fix = 2 if row.state & _FIXED else 1 if row.state & _PHASE_USED else 0
    slip = (1 if row.state & _SLIPPED else 0) | (2 if row.state & _HALF_CYCLE else 0)
    residuals = f"{_number(row.code_m):.4f},{_number(row.phase_m):.4f},{1 if row.state & USED else 0},{_number(row.cn0_dbhz):.0f}"
    counts = f"{fix},{slip},{_count(row.lock)},0,{_count(row.slips)},{_count(row.rejects)}"
    text = f"{_name(row.id)},{row.frequency},{_direction(row)},{residuals},{counts}"
    if dialect == "2.4":
        return text
    return f"{text},{_number(row.ambiguity_cyc):.2f},{_number(row.variance_cyc2):.6f},{0.0:.5f}"


def ionosphere(rows: Sequence[Row]) -> Iterator[str]:
    """Yield what follows the status in $ION of the satellites whose delay is estimated; the delay of a fix is not told."""
    for id_, row in {row.id: row for row in rows if isfinite(row.ionosphere_m)}.items():
        yield f"{_name(id_)},{_direction(row)},{row.ionosphere_m / _slant(row.elevation_deg):.4f},{0.0:.4f}"


def _rows(message: SatellitesMessage) -> Iterator[Row]:
    count = len(message.satellite)
    newer = (message.ambiguity_variance_cyc2, message.lock_epochs, message.rejects, message.ionosphere_m)
    columns = zip(
        message.satellite, message.signal, message.state, message.azimuth_deg, message.elevation_deg, message.cn0_dbhz,
        message.code_residual_m, message.phase_residual_m, message.ambiguity_cyc, message.slips, *(_padded(one, count) for one in newer),
        strict=True,
    )  # fmt: skip
    for id_, signal, *values in columns:
        yield Row(id_, _FREQUENCIES.get(id_[:1], {}).get(signal[:1], 0), *values)


def _padded(values: Sequence[float], count: int) -> Sequence[float]:
    """Return a column that older solvers do not send."""
    return values if len(values) == count else [nan] * count


def _slant(elevation_deg: float) -> float:
    """Return slant over vertical delay of a single layer, seen from the ellipsoid."""
    sine = WGS84_A_M / (WGS84_A_M + _IONOSPHERE_M) * cos(radians(elevation_deg))
    return 1.0 / cos(asin(sine)) if isfinite(sine) else nan


def _name(id_: str) -> str:
    return str(int(id_[1:]) + _SBAS_PRN) if id_[0] == "S" else id_


def _direction(row: Row) -> str:
    return f"{_number(row.azimuth_deg):.1f},{_number(row.elevation_deg):.1f}"


def _number(value: float) -> float:
    return value if isfinite(value) else 0.0


def _count(value: float) -> int:
    return max(int(_number(value)), 0)
