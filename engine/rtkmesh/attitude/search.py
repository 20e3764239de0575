"""Integers of several baselines chosen together: the known places of the antennas decide between the candidates of each baseline.

Maximised is the posterior of integers and rotation: squared norms of the float ambiguities plus the chi-square of the rigid body with the
joint covariance of the baselines, which share receivers. It is as good as the best other combination lets it be: the same odds as in
``models.odds``. Integers around a triangle of antennas must add up to zero: no noise excuses it when they do not.

Source: P. Teunissen, "Integer least-squares theory for the GNSS compass", J. Geodesy 84 (2010) 433-447 (the constrained objective); how
it is minimised here, over few candidates of each baseline, is our own.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cache, lru_cache
from math import exp, inf, isfinite, log, pi
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.attitude.candidates import Candidates, Pairs, pairs_of
from rtkmesh.attitude.chi_square import chi_square_limit
from rtkmesh.attitude.closure import closure, triangles
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
    two, costs, rotation = _searched(layout, sorted_tables, expected)
    if not isfinite(costs[0]):
        return Choice(Verdict.NO_COMBINATION)
    best, second = (tuple(places[order.index(i)] for i in range(len(tables))) for places in two.tolist())
    return _judged(layout, tables, expected, best, second if isfinite(costs[1]) else (), costs, rotation, failure_rate)


def _judged(
    layout: Layout, tables: Sequence[Candidates], expected: Expectation, best: tuple[int, ...], second: tuple[int, ...], costs: Vector,
    rotation: Matrix, failure_rate: float,
) -> Choice:  # fmt: skip
    """Return the choice with its fit, its odds and the verdict."""
    values = np.array([table.baselines_ned_m[k] for table, k in zip(tables, best, strict=True)])
    measured = baselines(pairs_of(tables), len(layout.names), values, joint_covariance(tables))
    fitted = fit(layout, measured, expected.ned_from_body, rotation)
    count = sum(table.count for table in tables) * _rank(pairs_of(tables)) / len(tables)
    other = min(float(costs[1]), _unseen(tables))
    odds = float(log_odds(float(costs[0]), other, round(count))) if isfinite(other) else inf
    open_triangles, sums = closure(tables, best)
    verdict = Verdict.ACCEPTED
    if min((table.count for table in tables if not table.known), default=0) < LEAST_AMBIGUITIES:
        verdict = Verdict.FEW_AMBIGUITIES
    elif open_triangles:
        verdict = Verdict.CLOSURE
    elif fitted is None or fitted.chi_square > _limit(max(fitted.degrees, 1)):
        verdict = Verdict.GEOMETRY
    elif costs[0] > NORM_LIMIT * count:
        verdict = Verdict.NORM
    elif odds < -SURENESS * log(failure_rate):
        verdict = Verdict.NOT_SURE
    return Choice(verdict, best, second, fitted, measured, float(costs[0]), other, odds, open_triangles, sums)


def _unseen(tables: Sequence[Candidates]) -> float:
    """Return the least cost of a combination with an integer vector that is in no table."""
    share = _share(pairs_of(tables))
    least = [float(table.norms.min()) for table in tables]
    return share * (sum(least) + min(table.beyond - norm for table, norm in zip(tables, least, strict=True)))


@cache
def _limit(degrees: int) -> float:
    return chi_square_limit(FALSE_ALARM, degrees)


def _searched(layout: Layout, tables: Sequence[Candidates], expected: Expectation) -> tuple[Indices, Vector, Matrix]:
    """Return the two best combinations as numbers of candidates (2, k), their costs, and the rotation of the best."""
    k, (values, norms, sizes) = len(tables), _side_by_side(tables)
    body = np.array([layout.positions_m[table.end] - layout.positions_m[table.start] for table in tables])
    cov = joint_covariance(tables)
    if layout.cov_m2 is not None:
        cov += _blurred(layout.cov_m2, tables)
    spread, axes = _spread(cov)
    loops = _loops(pairs_of(tables))
    start = np.ascontiguousarray(np.eye(3) if expected.ned_from_body is None else expected.ned_from_body)
    known: Matrix = np.zeros((3, 3)) if expected.cov_rad2 is None else np.linalg.inv(expected.cov_rad2).astype(np.float64)
    two, costs, rotation = np.zeros((2, k), np.int64), np.full(2, inf), np.eye(3)
    search_combinations(
        values, norms, sizes, body, _weights(cov), spread, axes, loops, _loop_weights(loops, cov), start, known, expected.tilt_rad, two,
        costs, rotation,
    )  # fmt: skip
    return two, costs, rotation


def _side_by_side(tables: Sequence[Candidates]) -> tuple[NDArray[np.float64], Matrix, Indices]:
    """Return the baselines (k, m, 3; NED, m) and norms (k, m) of all candidates, zeros behind the last of a table, and how many it has."""
    k, most, share = len(tables), max(len(table.norms) for table in tables), _share(pairs_of(tables))
    values, norms = np.zeros((k, most, 3)), np.zeros((k, most))
    for j, table in enumerate(tables):
        values[j, : len(table.norms)], norms[j, : len(table.norms)] = table.baselines_ned_m, share * table.norms
    return values, norms, np.array([len(table.norms) for table in tables])


def _weights(cov_m2: Matrix) -> NDArray[np.float64]:
    """Return the weights of the first j + 1 vectors together (j, 3 k, 3 k)."""
    k = len(cov_m2) // 3
    weights = np.zeros((k, 3 * k, 3 * k))
    for j in range(1, k + 1):
        weights[j - 1, : 3 * j, : 3 * j] = np.linalg.inv(cov_m2[: 3 * j, : 3 * j])
    return weights


def _spread(cov_m2: Matrix) -> tuple[Matrix, Matrix]:
    """Return variances (k, k, 3) and axes (k, k, 3, 3; columns) of each of k vectors (diagonal) and of the differences of two."""
    k = len(cov_m2) // 3
    blocks = cov_m2.reshape(k, 3, k, 3).swapaxes(1, 2)
    own = blocks[np.arange(k), np.arange(k)]
    apart = own[:, None] + own[None] - blocks - blocks.transpose(1, 0, 2, 3)
    apart[np.arange(k), np.arange(k)] = own
    values, vectors = np.linalg.eigh(apart)
    return np.maximum(values, 1e-12), np.ascontiguousarray(vectors)


@lru_cache(maxsize=256)
def _loops(pairs: Pairs) -> Indices:
    """Return the triangles among baselines as rows (l, 5): the last side, the two others, and the signs with which these add up to it."""
    rows: list[tuple[int, ...]] = []
    for triangle in triangles(pairs):
        one, two, last = sorted(triangle)
        first = 1 if pairs[one][0] == pairs[last][0] or pairs[one][1] == pairs[last][1] else -1
        second = 1 if pairs[two][0] == pairs[last][0] or pairs[two][1] == pairs[last][1] else -1
        rows.append((last, one, two, first, second))
    return np.array(rows, np.int64).reshape(-1, 5)


def _loop_weights(loops: Indices, cov_m2: Matrix) -> Matrix:
    """Return the inverse covariance (l, 3, 3) of what triangles are not closed by."""
    k = len(cov_m2) // 3
    mix = np.zeros((len(loops), k))
    for row, (last, one, two, first, second) in zip(mix, loops.tolist(), strict=True):
        row[last], row[one], row[two] = 1.0, -first, -second
    gaps: Matrix = np.einsum("li,iajb,lj->lab", mix, cov_m2.reshape(k, 3, k, 3), mix)
    return np.linalg.inv(gaps).astype(np.float64)


@lru_cache(maxsize=256)
def _correlation(pairs: Pairs, shared: float) -> Matrix:
    """Return the correlation (k, k) of baselines between receivers that are equally good, off the diagonal ``shared`` of it."""
    ends = np.zeros((len(pairs), 1 + max(max(pair) for pair in pairs)))
    for row, (start, end) in zip(ends, pairs, strict=True):
        row[start] -= 1.0
        row[end] += 1.0
    full: Matrix = 0.5 * ends @ ends.T
    found: Matrix = shared * full + (1.0 - shared) * np.eye(len(pairs))
    found.flags.writeable = False
    return found


@lru_cache(maxsize=256)
def _rank(pairs: Pairs) -> int:
    """Return how many of the baselines do not follow from others."""
    return int(np.sum(np.linalg.eigvalsh(_correlation(pairs, 1.0)) > 1e-6))


@lru_cache(maxsize=256)
def _share(pairs: Pairs) -> float:
    """Return by what the sum of squared norms is multiplied: float ambiguities of baselines that share receivers say the same thing twice.

    Exact where all pairs of antennas are baselines (2/n of n antennas), else the least that the joint norm can be.
    """
    return 1.0 / float(np.linalg.eigvalsh(_correlation(pairs, 1.0))[-1])


def joint_covariance(tables: Sequence[Candidates]) -> Matrix:
    """Return the joint covariance (3k, 3k) of baselines that share receivers: each is the sum of two single receivers' variances."""
    k = len(tables)
    roots = np.linalg.cholesky(np.array([table.cov_ned_m2 for table in tables]))
    joint: Matrix = np.einsum("ij,iac,jbc->iajb", _correlation(pairs_of(tables), _SHARED), roots, roots).reshape(3 * k, 3 * k)
    return joint


def _blurred(cov_m2: Matrix, tables: Sequence[Candidates]) -> Matrix:
    """Return what is not known of a layout as a covariance (3k, 3k) of the baselines that is the same for every rotation."""
    k, n = len(tables), len(cov_m2) // 3
    mix = np.zeros((k, n))
    for row, table in zip(mix, tables, strict=True):
        row[table.start], row[table.end] = -1.0, 1.0
    mean: Matrix = np.einsum("iaja->ij", cov_m2.reshape(n, 3, n, 3)).astype(np.float64) / 3.0
    return np.asarray(np.kron(mix @ mean @ mix.T, np.eye(3)), np.float64)
