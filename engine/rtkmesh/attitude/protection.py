"""How far an attitude may be off although its tests have passed: protection levels of heading, pitch and roll.

Any one antenna may be at fault, by any amount, with a prior probability. The attitude without it is not touched by that, so the published
one is off by no more than what separates the two plus what the other is off itself: solution separation (Blanch et al. 2015, IEEE Trans.
AES 51:713) with the separation that is seen in place of the largest one that passes a test. So the bound needs no test to have passed and
no probability to miss a fault. First order about the published rotation. What is assumed: docs/concepts/rigid-body.md.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from math import exp, inf, log, nan, sqrt
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh.attitude.integrity import Finding, Judged
from rtkmesh.attitude.joint import Edge, angles_covariance
from rtkmesh.attitude.rigid_body import Fit, Layout, Measured, jacobian_of, level_turn, misfit_covariance
from rtkmesh.attitude.rotation import angles_per_error

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

INFLATION: Final = 1.5  # of sigmas: mean squares of normalised errors of fixes reach 1.7 on recordings
_RARE: Final = 1e-2  # of the risk: two faults at once that are less likely are left out
_UNSEEN: Final = 1e-8  # a direction with a smaller share of the information is not seen
_SAME: Final = 1e-10  # of what is not asked for: a mix of antennas that says nothing


@dataclass(frozen=True, slots=True)
class Guarding:
    """What levels are for. ``risk``: probability per epoch of an angle that is further off than its level.

    ``antenna_fault``: prior probability per epoch that what an antenna measures is off by more than its sigmas say (on top of the wrong
    integers that solvers tell of). ``unseen_sigma_rad``: how level the body is about a line of antennas.
    """

    risk: float = 1e-5
    antenna_fault: float = 1e-4
    unseen_sigma_rad: float = 0.1745


@dataclass(frozen=True, slots=True, eq=False)
class Levels:
    """Protection levels (3; rad) of heading, pitch, roll: infinite where nothing bounds the error, NaN for what is not seen.

    ``open``: the antennas whose fault nothing else would show in an angle.
    """

    rad: Vector
    open: tuple[str, ...] = ()


class _Hypothesis(NamedTuple):
    """These antennas are at fault, with a probability."""

    prior: float
    gone: tuple[int, ...]


class _Other(NamedTuple):
    """The attitude without some antennas: its rotation (rad, NED) from the published one, and covariance of what it sees.

    ``unseen``: a direction that it does not see and of which only the level is known.
    """

    turn_rad: Vector
    cov: Matrix
    unseen: Vector | None


@dataclass(frozen=True, slots=True, eq=False)
class _Model:
    """The fit to first order about a rotation: X' W X of the columns of ``X``, which are derivatives of the misfit by every antenna's place
    (3 each), by the origin (3; none without positions) and by the rotation (3), and the misfit itself.
    """

    rotation: Matrix
    information: Matrix
    antennas: int


def fault_priors(layout: Layout, edges: Sequence[Edge], antenna_fault: float) -> Vector:
    """Return the prior probability of a fault of each antenna: its own, and that the integers of an edge that ends there are wrong."""
    priors = np.full(len(layout.names), antenna_fault)
    for edge in edges:
        if edge.end in layout.names:
            priors[layout.names.index(edge.end)] += edge.wrong
    return np.minimum(priors, 1.0)


def levels(layout: Layout, measured: Measured, verdict: Judged, guarding: Guarding, priors: Vector | None = None) -> Levels:
    """Return the protection levels of a judged attitude of what was measured.

    ``priors``: of a fault of each antenna of the layout (``fault_priors``); None: that of ``guarding``.
    """
    found = verdict.fit
    if found is None:
        return Levels(np.full(3, nan))
    faults = np.full(len(layout.names), guarding.antenna_fault) if priors is None else priors
    model = _model(layout, measured, found)
    hypotheses = _hypotheses(layout, measured, verdict, faults, guarding.risk)
    share = 0.5 * guarding.risk / max(len(hypotheses), 1)
    asked = [hypothesis for hypothesis in hypotheses if hypothesis.prior > share]
    others, turn = _without(model, [gone for _, gone in asked]), angles_per_error(model.rotation)
    level, left_open = _own_level(found, guarding), set[int]()
    for prior, gone in asked:
        bound = _bound(turn, others[gone], widening(prior, share), guarding.unseen_sigma_rad)
        left_open |= {*gone} if np.isinf(bound).any() else set()
        level = np.maximum(level, bound)
    seen = np.isfinite(np.diag(angles_covariance(found, guarding.unseen_sigma_rad)))
    excluded = set(_numbers(layout, verdict.excluded))
    return Levels(np.where(seen, level, nan), tuple(layout.names[i] for i in sorted(left_open - excluded)))


def line_levels(sigmas_rad: Vector, prior: float, guarding: Guarding) -> Vector:
    """Return the levels of angles (n; NaN: not seen) of one baseline, each of whose antennas is at fault with probability ``prior``.

    Nothing but its length tests it, and a fault across it changes no length: it is likelier than the risk allows, or not looked at.
    """
    if prior > 0.25 * guarding.risk:
        return np.where(np.isfinite(sigmas_rad), inf, nan)
    return widening(1.0, 0.5 * guarding.risk) * INFLATION * sigmas_rad


def widening(prior: float, share: float) -> float:
    """Return how many sigmas a normal error of a hypothesis of probability ``prior`` stays within but for ``share`` of probability."""
    return sqrt(2.0 * log(prior / share)) if prior > share else 0.0


def _numbers(layout: Layout, names: tuple[str, ...]) -> tuple[int, ...]:
    return tuple(layout.names.index(name) for name in names)


def _hypotheses(layout: Layout, measured: Measured, verdict: Judged, faults: Vector, risk: float) -> list[_Hypothesis]:
    """Return what else may be wrong, with its probability given the verdict."""
    seen = [int(i) for i in np.flatnonzero(measured.seen)]
    if verdict.finding is Finding.NOT_IDENTIFIABLE:
        return [_Hypothesis(1.0, (i,)) for i in seen]
    excluded = _numbers(layout, verdict.excluded)
    sound = [i for i in seen if i not in excluded]
    more = [_Hypothesis(float(faults[i]), (*excluded, i)) for i in sound]
    pairs = [_Hypothesis(float(faults[i] * faults[j]), (*excluded, i, j)) for i, j in combinations(sound, 2)]
    more += [pair for pair in pairs if pair.prior > _RARE * risk]
    others = [(_numbers(layout, names), worse) for names, worse in verdict.instead]
    return more + [_Hypothesis(_odds(faults, chosen, excluded, worse), chosen) for chosen, worse in others]


def _odds(faults: Vector, chosen: tuple[int, ...], excluded: tuple[int, ...], worse: float) -> float:
    """Return how likely others were at fault than those that were excluded; ``worse``: by how much the chi-square without them is."""
    ratio = float(np.prod(faults[[*chosen]]) / max(float(np.prod(faults[[*excluded]])), 1e-300))
    return min(1.0, ratio * exp(-0.5 * max(worse, 0.0)))


def _own_level(found: Fit, guarding: Guarding) -> Vector:
    """Return the level while nothing is wrong."""
    scale = widening(1.0, 0.5 * guarding.risk)
    turn = angles_per_error(found.ned_from_body)
    return scale * _sigmas(turn, found.cov[:3, :3], found.unseen_ned, guarding.unseen_sigma_rad)


def _sigmas(turn: Matrix, cov: Matrix, unseen: Vector | None, unseen_sigma_rad: float) -> Vector:
    """Return the inflated sigmas of the angles; what only the level says of a direction is not inflated."""
    variances = INFLATION**2 * np.diag(turn @ cov @ turn.T)
    if unseen is not None:
        variances = variances + np.square(turn @ unseen * unseen_sigma_rad)
    return np.sqrt(np.maximum(variances, 0.0))


def _bound(turn: Matrix, other: _Other | None, scale: float, unseen_sigma_rad: float) -> Vector:
    """Return how far angles may be off if the ``other`` attitude is not touched; infinite where there is none.

    ``turn``: derivative of the angles by the rotation's error.
    """
    if other is None:
        return np.full(3, inf)
    return np.abs(turn @ other.turn_rad) + scale * _sigmas(turn, other.cov, other.unseen, unseen_sigma_rad)


def _model(layout: Layout, measured: Measured, found: Fit) -> _Model:
    rotation, share = found.ned_from_body, measured.weights.sum(axis=1)
    turned = measured.weights @ layout.positions_m @ rotation.T
    misfit = measured.values_ned_m - turned
    columns = [_per_axis(measured.weights)]
    if measured.absolute:
        columns.append(_per_axis(share[:, None]))
        misfit = misfit - np.outer(share, found.origin_ned_m)
    x = np.hstack([*columns, jacobian_of(turned, share, absolute=False), misfit.reshape(-1, 1)])
    return _Model(rotation, x.T @ np.linalg.solve(misfit_covariance(layout, measured, rotation), x), len(layout.names))


def _per_axis(weights: Matrix) -> Matrix:
    """Return weights (k, n) as derivatives (3k, 3n) of vectors by places."""
    return np.einsum("kn,ab->kanb", weights, np.eye(3)).reshape(3 * len(weights), -1)


def _without(model: _Model, sets: Sequence[tuple[int, ...]]) -> dict[tuple[int, ...], _Other | None]:
    """Return the attitudes when each of these sets of antennas may be anywhere; None where that leaves more than one direction open."""
    found: dict[tuple[int, ...], _Other | None] = {}
    for size in dict.fromkeys(len(gone) for gone in sets):
        alike = list(dict.fromkeys(gone for gone in sets if len(gone) == size))
        found |= dict(zip(alike, _without_each(model, np.array(alike, np.int64)), strict=True))
    return found


def _without_each(model: _Model, sets: NDArray[np.int64]) -> list[_Other | None]:
    """Return the attitudes without each row (m antennas) of ``sets``, all at once.

    Where they are, and the origin, is eliminated from the normal equations (Schur complement).
    """
    n, told = len(model.information), model.information
    places = (3 * sets[:, :, None] + np.arange(3)).reshape(len(sets), -1)
    origin = np.arange(3 * model.antennas, n - 4)
    free = np.hstack([places, np.broadcast_to(origin, (len(sets), len(origin)))])
    values, vectors = np.linalg.eigh(told[free[:, :, None], free[:, None, :]])
    kept = values > _SAME * values[:, -1:]
    projected = vectors.swapaxes(1, 2) @ told[free, n - 4 :]
    weighted = projected * np.where(kept, 1.0 / np.where(kept, values, 1.0), 0.0)[:, :, None]
    reduced = told[n - 4 :, n - 4 :] - projected.swapaxes(1, 2) @ weighted
    scale = float(np.trace(told[n - 4 : n - 1, n - 4 : n - 1]))
    values, vectors = np.linalg.eigh(reduced[:, :3, :3])
    return [_solved(model.rotation, *row, scale) for row in zip(values, vectors, reduced[:, :3, 3], strict=True)]


def _solved(rotation: Matrix, values: Vector, vectors: Matrix, right: Vector, scale: float) -> _Other | None:
    """Return the solution of normal equations of a rotation by their eigenvalues; ``scale``: of the information of all."""
    seen = values > _UNSEEN * scale
    if int(seen.sum()) < 2:
        return None
    cov = (vectors[:, seen] / values[seen]) @ vectors[:, seen].T
    turn = cov @ right
    if seen.all():
        return _Other(turn, cov, None)
    unseen = vectors[:, 0]
    return _Other(turn + level_turn(rotation, unseen) * unseen, cov, unseen)
