"""Integers of several baselines chosen together: the known places of the antennas decide between the candidates of each baseline.

Maximised is the posterior of integers and rotation: squared norms of the float ambiguities plus the chi-square of the rigid body with the
joint covariance of the baselines, which share receivers. It is as good as the best other combination lets it be: the same odds as in
``models.odds``. Integers around a triangle of antennas must add up to zero: no noise excuses it when they do not.

Source: P. Teunissen, "Integer least-squares theory for the GNSS compass", J. Geodesy 84 (2010) 433-447 (the constrained objective); how
it is minimised here, over few candidates of each baseline, is our own.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import combinations
from math import exp, inf, isfinite, log, pi
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.attitude.chi_square import chi_square_limit
from rtkmesh.attitude.combinations import search_combinations
from rtkmesh.attitude.rigid_body import Fit, Layout, Measured, baselines, fit
from rtkmesh.models.odds import NORM_LIMIT, SURENESS, log_odds

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]

FAILURE_RATE: Final = 0.01
FALSE_ALARM: Final = 1e-4  # of the test of the geometry that the best combination must pass
LEAST_AMBIGUITIES: Final = 4  # double differences per baseline
_SHARED: Final = 0.9  # of the correlation that a shared receiver makes: satellites and multipath are not quite the same


class Verdict(StrEnum):
    """What became of a choice, and why it is not accepted."""

    ACCEPTED = "accepted"
    NO_CANDIDATES = "no candidates"
    FEW_AMBIGUITIES = "few ambiguities"
    NO_COMBINATION = "no combination fits"
    NORM = "float ambiguities too far"
    GEOMETRY = "geometry"
    CLOSURE = "closure"
    NOT_SURE = "not sure"


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """Candidate integers of a baseline: what ``rtk.candidates.CandidateTable`` has, between antennas ``start`` and ``end`` of a layout.

    ``baselines_ned_m`` (m, 3) is end minus start under each candidate, ``cov_ned_m2`` (3, 3) the covariance given integers; ``norms`` (m)
    squared norms, ``beyond`` the least of what is not in the table; ``count`` double differences. Columns of ``integers`` (m, p, cycles,
    single differences): satellite, the signal at the end and at the start antenna, all numbers.
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


@dataclass(frozen=True, slots=True, eq=False)
class Expectation:
    """What is known of the attitude beforehand: the body's down axis is within ``tilt_rad`` of the vertical; ``ned_from_body`` (3x3), where
    a filter expects it, with the covariance (3x3, rad^2) of its error in NED. By default nothing.
    """

    tilt_rad: float = pi
    ned_from_body: Matrix | None = None
    cov_rad2: Matrix | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """The best combination: per baseline the number of its candidate, and how sure it is.

    ``fit``: the rotation by ``rigid_body.fit``; ``measured``: the baselines that it is of. ``cost``: squared norms and chi-square of the
    best, ``other`` of the runner-up. ``open_triangles``: double differences around triangles that are not zero, of ``triangle_sums``.
    """

    verdict: Verdict
    chosen: tuple[int, ...] = ()
    runner_up: tuple[int, ...] = ()
    fit: Fit | None = None
    measured: Measured | None = None
    cost: float = inf
    other: float = inf
    log_odds: float = -inf
    open_triangles: int = 0
    triangle_sums: int = 0

    @property
    def accepted(self) -> bool:
        """Whether the integers may be used."""
        return self.verdict is Verdict.ACCEPTED

    @property
    def wrong_probability(self) -> float:
        """Probability that the combination is wrong, as calibrated for the engine's own fixes."""
        return 1.0 if self.log_odds <= 0.0 else exp(-self.log_odds / SURENESS)


NOTHING_EXPECTED: Final = Expectation()


def choose(
    layout: Layout, tables: Sequence[Candidates], expected: Expectation = NOTHING_EXPECTED, failure_rate: float = FAILURE_RATE
) -> Choice:
    """Return the combination of candidates, one of each baseline, that fits float ambiguities and layout best, and whether it is accepted.

    ``failure_rate``: accepted only if it is wrong with no higher probability.
    """
    if not tables or any(not len(table.norms) for table in tables):
        return Choice(Verdict.NO_CANDIDATES)
    order = sorted(range(len(tables)), key=lambda i: (-tables[i].count, tables[i].start, tables[i].end))
    sorted_tables = [tables[i] for i in order]
    rows: list[Indices] = [np.argsort(table.norms, kind="stable").astype(np.int64) for table in sorted_tables]
    two, costs = _searched(layout, sorted_tables, rows, expected)
    if not isfinite(costs[0]):
        return Choice(Verdict.NO_COMBINATION)
    numbers = [{i: int(row[at]) for i, row, at in zip(order, rows, places.tolist(), strict=True)} for places in two]
    best, second = (tuple(by_table[i] for i in range(len(tables))) for by_table in numbers)
    return _judged(layout, tables, expected, best, second if isfinite(costs[1]) else (), costs, failure_rate)


def _judged(
    layout: Layout, tables: Sequence[Candidates], expected: Expectation, best: tuple[int, ...], second: tuple[int, ...], costs: Vector,
    failure_rate: float,
) -> Choice:  # fmt: skip
    """Return the choice with its fit, its odds and the verdict."""
    values = np.array([table.baselines_ned_m[k] for table, k in zip(tables, best, strict=True)])
    pairs = tuple((table.start, table.end) for table in tables)
    measured = baselines(pairs, len(layout.names), values, joint_covariance(tables))
    fitted = fit(layout, measured, expected.ned_from_body)
    count = sum(table.count for table in tables) * _rank(tables) / len(tables)
    other = min(float(costs[1]), _unseen(tables))
    odds = float(log_odds(float(costs[0]), other, round(count))) if isfinite(other) else inf
    open_triangles, sums = closure(tables, best)
    verdict = Verdict.ACCEPTED
    if min(table.count for table in tables) < LEAST_AMBIGUITIES:
        verdict = Verdict.FEW_AMBIGUITIES
    elif open_triangles:
        verdict = Verdict.CLOSURE
    elif fitted is None or fitted.chi_square > chi_square_limit(FALSE_ALARM, max(fitted.degrees, 1)):
        verdict = Verdict.GEOMETRY
    elif costs[0] > NORM_LIMIT * count:
        verdict = Verdict.NORM
    elif odds < -SURENESS * log(failure_rate):
        verdict = Verdict.NOT_SURE
    return Choice(verdict, best, second, fitted, measured, float(costs[0]), other, odds, open_triangles, sums)


def _unseen(tables: Sequence[Candidates]) -> float:
    """Return the least cost of a combination with an integer vector that is in no table."""
    share = _share(tables)
    least = [float(table.norms.min()) for table in tables]
    return share * (sum(least) + min(table.beyond - norm for table, norm in zip(tables, least, strict=True)))


def _searched(layout: Layout, tables: Sequence[Candidates], rows: Sequence[Indices], expected: Expectation) -> tuple[Indices, Vector]:
    """Return the two best combinations as places in the sorted rows (2, k), and their costs."""
    k, most = len(tables), max(len(row) for row in rows)
    values, norms, share = np.zeros((k, most, 3)), np.zeros((k, most)), _share(tables)
    for j, (table, row) in enumerate(zip(tables, rows, strict=True)):
        values[j, : len(row)], norms[j, : len(row)] = table.baselines_ned_m[row], share * table.norms[row]
    body = np.array([layout.positions_m[table.end] - layout.positions_m[table.start] for table in tables])
    cov = joint_covariance(tables) + _blurred(layout, tables)
    weights = np.zeros((k, 3 * k, 3 * k))
    for j in range(1, k + 1):
        weights[j - 1, : 3 * j, : 3 * j] = np.linalg.inv(cov[: 3 * j, : 3 * j])
    own = np.zeros((k, 3, 3))
    own[:] = [np.linalg.inv(cov[3 * j : 3 * j + 3, 3 * j : 3 * j + 3]) for j in range(k)]
    spread = _largest_variances(cov)
    predicted = np.eye(3) if expected.ned_from_body is None else expected.ned_from_body
    known: Matrix = np.zeros((3, 3)) if expected.cov_rad2 is None else np.linalg.inv(expected.cov_rad2).astype(np.float64)
    two, costs = np.zeros((2, k), np.int64), np.full(2, inf)
    sizes = np.array([len(row) for row in rows])
    start = np.ascontiguousarray(predicted)
    search_combinations(values, norms, sizes, body, weights, own, spread, start, known, expected.tilt_rad, two, costs)
    return two, costs


def _largest_variances(cov_m2: Matrix) -> Matrix:
    """Return the largest variance of a component of each of k vectors (diagonal) and of the differences of two (k, k)."""
    k = len(cov_m2) // 3
    blocks = cov_m2.reshape(k, 3, k, 3).swapaxes(1, 2)
    own = blocks[np.arange(k), np.arange(k)]
    apart = own[:, None] + own[None] - blocks - blocks.transpose(1, 0, 2, 3)
    apart[np.arange(k), np.arange(k)] = own
    return np.ascontiguousarray(np.linalg.eigvalsh(0.5 * (apart + apart.swapaxes(2, 3)))[..., -1], np.float64)


def _correlation(tables: Sequence[Candidates], shared: float) -> Matrix:
    """Return the correlation (k, k) of baselines between receivers that are equally good, off the diagonal ``shared`` of it."""
    ends = np.zeros((len(tables), 1 + max(max(table.start, table.end) for table in tables)))
    for row, table in zip(ends, tables, strict=True):
        row[table.start] -= 1.0
        row[table.end] += 1.0
    full: Matrix = 0.5 * ends @ ends.T
    return shared * full + (1.0 - shared) * np.eye(len(tables))


def _rank(tables: Sequence[Candidates]) -> int:
    """Return how many of the baselines do not follow from others."""
    return int(np.sum(np.linalg.eigvalsh(_correlation(tables, 1.0)) > 1e-6))


def _share(tables: Sequence[Candidates]) -> float:
    """Return by what the sum of squared norms is multiplied: float ambiguities of baselines that share receivers say the same thing twice.

    Exact where all pairs of antennas are baselines (2/n of n antennas), else the least that the joint norm can be.
    """
    return 1.0 / float(np.linalg.eigvalsh(_correlation(tables, 1.0))[-1])


def joint_covariance(tables: Sequence[Candidates]) -> Matrix:
    """Return the joint covariance (3k, 3k) of baselines that share receivers: each is the sum of two single receivers' variances."""
    roots = np.zeros((3 * len(tables), 3 * len(tables)))
    for j, table in enumerate(tables):
        roots[3 * j : 3 * j + 3, 3 * j : 3 * j + 3] = np.linalg.cholesky(table.cov_ned_m2)
    joint: Matrix = roots @ np.kron(_correlation(tables, _SHARED), np.eye(3)) @ roots.T
    return joint


def _blurred(layout: Layout, tables: Sequence[Candidates]) -> Matrix:
    """Return what is not known of the layout as a covariance (3k, 3k) of the baselines that is the same for every rotation."""
    k, n = len(tables), len(layout.names)
    if layout.cov_m2 is None:
        return np.zeros((3 * k, 3 * k))
    mix = np.zeros((k, n))
    for row, table in zip(mix, tables, strict=True):
        row[table.start], row[table.end] = -1.0, 1.0
    mean: Matrix = np.einsum("iaja->ij", layout.cov_m2.reshape(n, 3, n, 3)).astype(np.float64) / 3.0
    return np.asarray(np.kron(mix @ mean @ mix.T, np.eye(3)), np.float64)


def closure(tables: Sequence[Candidates], chosen: Sequence[int]) -> tuple[int, int]:
    """Return how many double differences do not add up to zero around the triangles of antennas that are solved, and of how many."""
    different, sums = 0, 0
    edges = {(table.start, table.end): _signed(table, k, 1) for table, k in zip(tables, chosen, strict=True)}
    edges |= {(table.end, table.start): _signed(table, k, -1) for table, k in zip(tables, chosen, strict=True)}
    antennas = sorted({start for start, _ in edges})
    for a, b, c in combinations(antennas, 3):
        if (a, b) in edges and (b, c) in edges and (c, a) in edges:
            bad, count = _around(edges[a, b], edges[b, c], edges[c, a])
            different, sums = different + bad, sums + count
    return different, sums


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
                    groups.setdefault((satellite // 64, start, middle, last), []).append(one + two + three)
    return sum(sum(total != totals[0] for total in totals[1:]) for totals in groups.values()), sum(len(t) - 1 for t in groups.values())
