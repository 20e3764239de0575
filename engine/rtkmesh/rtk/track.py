"""The solutions of a run as one table, half a kilobyte an epoch: a day at 1 Hz is 42 MB. Single satellites are not in it."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.gnss.integrity import Integrity
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.solution import USED_PHASE, IntegrityReason, Reason, SatelliteTable, Solution, Status

Table = NDArray[Any]  # structured, of ROW

_VECTORS: Final = (
    "position_ecef_m", "velocity_ecef_mps", "acceleration_ecef_mps2", "base_ecef_m", "baseline_ecef_m", "single_position_ecef_m",
)  # fmt: skip
_MATRICES: Final = ("position_cov_ecef_m2", "velocity_cov_ecef_m2ps2", "acceleration_cov_ecef_m2ps4", "baseline_cov_ecef_m2")
_REALS: Final = (
    "receiver_clock_s", "age_s", "ratio", "ratio_threshold", "success_rate", "code_rms_m", "phase_rms_m", "nis_per_observation", "waited_s",
    "fix_probability", "protection_horizontal_m", "protection_vertical_m",
)  # fmt: skip
_COUNTS: Final = (
    "grade", "ambiguities", "ambiguities_fixed", "satellites_used", "satellites_rover", "satellites_base", "resets",
)  # fmt: skip
_NAMES: Final = (*_VECTORS, *_MATRICES, *_REALS, *_COUNTS)
INTEGRITY: Final = tuple(Integrity)  # by its number in the table
# ``arc_s`` is the middle age (s) of the ambiguities that were used, NaN without any.
ROW: Final = np.dtype(
    [("week", "i4"), ("tow_s", "f8"), ("status", "i4"), ("reason", "i4"), ("integrity", "i4"), ("integrity_reason", "i4"), ("arc_s", "f8")]
    + [(name, "f8", (3,)) for name in _VECTORS]
    + [(name, "f8", (3, 3)) for name in _MATRICES]
    + [(name, "f8") for name in _REALS]
    + [(name, "i4") for name in _COUNTS]
)
_BLOCK: Final = 4096


@dataclass(slots=True)
class Track:
    """A growing table of solutions. Mutable; ``table`` gives what there is so far."""

    _rows: Table = field(default_factory=lambda: np.zeros(_BLOCK, ROW))
    _count: int = 0

    def __len__(self) -> int:
        return self._count

    def append(self, solution: Solution) -> None:
        """Take a solution in."""
        if self._count == len(self._rows):
            self._rows = np.concatenate((self._rows, np.zeros(len(self._rows) // 2, ROW)))
        integrity = INTEGRITY.index(solution.integrity), solution.integrity_reason
        first = solution.time.week, solution.time.tow_s, solution.status, solution.reason
        self._rows[self._count] = (*first, *integrity, _arc_s(solution.satellites), *(getattr(solution, name) for name in _NAMES))
        self._count += 1

    @property
    def table(self) -> Table:
        """The rows, in the order in which they came."""
        return self._rows[: self._count]


def track_of(solutions: Iterable[Solution]) -> Track:
    """Return the track of these solutions."""
    track = Track()
    for solution in solutions:
        track.append(solution)
    return track


def solutions_of(table: Table) -> Iterator[Solution]:
    """Yield the solutions of a table, without their satellites."""
    for row in table:
        values: dict[str, Any] = {name: row[name].copy() for name in (*_VECTORS, *_MATRICES)}
        values |= {name: row[name].item() for name in (*_REALS, *_COUNTS)}
        time = GpsTime(int(row["week"]), float(row["tow_s"]))
        values |= {"integrity": INTEGRITY[row["integrity"]], "integrity_reason": IntegrityReason(int(row["integrity_reason"]))}
        yield Solution(time=time, status=Status(int(row["status"])), reason=Reason(int(row["reason"])), **values)


def _arc_s(satellites: SatelliteTable) -> float:
    used = satellites.lock_s[satellites.state & USED_PHASE != 0]
    return float(np.median(used)) if len(used) else float("nan")
