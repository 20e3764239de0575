"""Integers around a triangle of antennas add up to zero: no noise excuses it when they do not, and one of the three is wrong.

Single differences of three receivers a, b, c around a triangle cancel but for the references of each group of signals: what is left of
double differences must be zero. Source: algorithms.md B6.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.attitude.candidates import Candidates, Pairs, pairs_of
from rtkmesh.gnss.beidou import is_geostationary
from rtkmesh.gnss.signals import SATELLITES_PER_SYSTEM

Vector = NDArray[np.float64]

_FAR_M: Final = 0.02  # a baseline that is further than this from every candidate is of none of them
_SAME_M: Final = 0.01  # candidates as near to it as the nearest but for this may be the ones that were fixed


def closure(tables: Sequence[Candidates], chosen: Sequence[int]) -> tuple[int, int]:
    """Return how many double differences do not add up to zero around the triangles of antennas that are solved, and of how many."""
    around = [closure_of(tables, chosen, triangle) for triangle in triangles(pairs_of(tables))]
    return sum(different for different, _ in around), sum(sums for _, sums in around)


@lru_cache(maxsize=256)
def triangles(pairs: Pairs) -> tuple[tuple[int, int, int], ...]:
    """Return which three of the baselines between pairs of antennas close a triangle, as numbers."""
    numbers = {frozenset(pair): number for number, pair in enumerate(pairs)}
    antennas = sorted({antenna for pair in pairs for antenna in pair})
    sides = [[frozenset(two) for two in ((a, b), (b, c), (c, a))] for a, b, c in combinations(antennas, 3)]
    return tuple((numbers[p], numbers[q], numbers[r]) for p, q, r in sides if p in numbers and q in numbers and r in numbers)


def closure_of(tables: Sequence[Candidates], chosen: Sequence[int], triangle: tuple[int, int, int]) -> tuple[int, int]:
    """Return how many double differences do not add up to zero around one triangle of baselines, and of how many."""
    first, second, third = (tables[i] for i in triangle)
    at = first.end if first.end in (second.start, second.end) else first.start
    edges = [_signed(first, chosen[triangle[0]], 1 if first.end == at else -1)]
    for number, table in ((triangle[1], second), (triangle[2], third)):
        edges.append(_signed(table, chosen[number], 1 if table.start == at else -1))
        at = table.end if table.start == at else table.start
    return _around(*edges)


_Edge = dict[tuple[int, int], dict[int, int]]  # (satellite, signal at the start) -> signal at the end -> integer


def _signed(table: Candidates, candidate: int, sign: int) -> _Edge:
    """Return the integers of a candidate, against the table's direction with ``sign`` -1."""
    edge: _Edge = {}
    first, last = (table.base_signal, table.signal) if sign > 0 else (table.signal, table.base_signal)
    integers = table.integers[candidate] if len(table.integers) else np.zeros(0, np.int64)
    for satellite, start, end, value in zip(table.satellite.tolist(), first.tolist(), last.tolist(), integers.tolist(), strict=True):
        edge.setdefault((satellite, start), {})[end] = sign * value
    return edge


def _around(first: _Edge, second: _Edge, third: _Edge) -> tuple[int, int]:
    """Return how many sums of integers around a triangle differ from that of their group's first satellite, and of how many."""
    groups: dict[tuple[int, ...], list[int]] = {}
    for (satellite, start), ends in first.items():
        for middle, one in ends.items():
            for last, two in second.get((satellite, middle), {}).items():
                three = third.get((satellite, last), {}).get(start)
                if three is not None:
                    clock = satellite // SATELLITES_PER_SYSTEM, is_geostationary(satellite)
                    groups.setdefault((*clock, start, middle, last), []).append(one + two + three)
    return sum(sum(total != totals[0] for total in totals[1:]) for totals in groups.values()), sum(len(t) - 1 for t in groups.values())


def fixed_among(table: Candidates, baseline_ned_m: Vector) -> Candidates | None:
    """Return a table of one candidate: the integers that a fixed baseline (3) tells of, where all candidates near it agree; None: of none.

    A solver that fixed a part of its ambiguities is near several candidates.
    """
    if not len(table.norms) or table.integers.shape != (len(table.norms), len(table.satellite)):
        return None
    off_m = np.linalg.norm(table.baselines_ned_m - baseline_ned_m, axis=1)
    nearest = int(np.argmin(off_m))
    if not off_m[nearest] <= _FAR_M:
        return None
    near = table.integers[off_m <= off_m[nearest] + _SAME_M]
    agreed = np.all(near == near[0], axis=0)
    return replace(
        table, baselines_ned_m=table.baselines_ned_m[[nearest]], norms=table.norms[[nearest]], satellite=table.satellite[agreed],
        signal=table.signal[agreed], base_signal=table.base_signal[agreed], integers=near[:1, agreed],
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Closing:
    """What the triangles of fixed baselines say: how many are ``closed``, the sides of the ``open`` ones, as numbers of baselines, and the
    one ``wrong`` baseline if all open triangles share it, and only it, and a closed one is without it.
    """

    closed: int = 0
    open: tuple[tuple[int, int, int], ...] = ()
    wrong: int | None = None


def closing(pairs: Pairs, fixed: Mapping[int, Candidates]) -> Closing:
    """Return what the triangles of those baselines between ``pairs`` that are fixed say, with the integers of each (``fixed_among``)."""
    told = [triangle for triangle in triangles(pairs) if all(side in fixed for side in triangle)]
    found = [closure_of([fixed[side] for side in triangle], (0, 0, 0), (0, 1, 2)) for triangle in told]
    open_ = tuple(triangle for triangle, (different, _) in zip(told, found, strict=True) if different)
    closed = [set(triangle) for triangle, (different, sums) in zip(told, found, strict=True) if sums and not different]
    shared = set[int]().union(*open_).intersection(*open_).difference(*closed) if open_ else set[int]()
    return Closing(len(closed), open_, shared.pop() if len(shared) == 1 and closed else None)
