"""What the search of integers of several baselines takes of each: its candidate integers and the baselines that follow from them."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import inf

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]
Pairs = tuple[tuple[int, int], ...]  # numbers of antennas, start and end, one pair per baseline


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """Candidate integers of a baseline: what ``rtk.candidates.CandidateTable`` has, between antennas ``start`` and ``end`` of a layout.

    ``baselines_ned_m`` (m, 3) is end minus start under each candidate, ``cov_ned_m2`` (3, 3) the covariance given integers; ``norms`` (m)
    squared norms, ``beyond`` the least of what is not in the table; ``count`` double differences. Columns of ``integers`` (m, p, cycles,
    single differences): satellite, the signal at the end and at the start antenna, all numbers. One candidate of no ambiguities is a
    baseline that is known: see ``known_baseline``.
    """

    start: int
    end: int
    baselines_ned_m: Matrix
    cov_ned_m2: Matrix
    norms: Vector
    count: int
    beyond: float = inf
    satellite: NDArray[np.int16] = field(default_factory=lambda: np.zeros(0, np.int16))
    signal: NDArray[np.int16] = field(default_factory=lambda: np.zeros(0, np.int16))
    base_signal: NDArray[np.int16] = field(default_factory=lambda: np.zeros(0, np.int16))
    integers: Indices = field(default_factory=lambda: np.zeros((0, 0), np.int64))

    @property
    def known(self) -> bool:
        """Whether it is one baseline that needs no search."""
        return len(self.norms) == 1 and self.count == 0


def known_baseline(start: int, end: int, baseline_ned_m: Vector, cov_ned_m2: Matrix) -> Candidates:
    """Return a baseline that is fixed already, between antennas ``start`` and ``end``, as what the search takes."""
    return Candidates(start, end, baseline_ned_m.reshape(1, 3), cov_ned_m2, np.zeros(1), 0)


def pairs_of(tables: Sequence[Candidates]) -> Pairs:
    """Return between which antennas tables are."""
    return tuple((table.start, table.end) for table in tables)
