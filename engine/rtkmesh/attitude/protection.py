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
from rtkmesh.attitude.rigid_body import Fit, Layout, Measured, plain
from rtkmesh.attitude.rotation import angles_per_error
from rtkmesh.attitude.separation_kernels import bounds_without, inflated_sigmas, normal_equations

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

INFLATION: Final = 1.5  # of sigmas: mean squares of normalised errors of fixes reach 1.7 on recordings
_RARE: Final = 1e-2  # of the risk: two faults at once that are less likely are left out


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


class Told(NamedTuple):
    """A measured baseline (m, NED) and its protection levels (m), as its solver tells them."""

    vector_ned_m: Vector
    horizontal_m: float
    vertical_m: float


class _Hypothesis(NamedTuple):
    """These antennas are at fault, with a probability."""

    prior: float
    gone: tuple[int, ...]


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
    hypotheses = _hypotheses(layout, measured, verdict, faults, guarding.risk)
    share = 0.5 * guarding.risk / max(len(hypotheses), 1)
    asked = [hypothesis for hypothesis in hypotheses if hypothesis.prior > share]
    level, left_open = _own_level(found, guarding), set[int]()
    if asked:
        bounds = _bounds(layout, measured, found, asked, share, guarding)
        level = np.maximum(level, bounds.max(axis=0))
        left_open = {i for hypothesis, bound in zip(asked, bounds, strict=True) if np.isinf(bound).any() for i in hypothesis.gone}
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


def baseline_levels(rotation: Matrix, line_ned: Vector, told: Told, guarding: Guarding) -> Vector:
    """Return the levels (3; rad) of heading, pitch, roll of antennas on one line by what the solver of their baseline bounds.

    ``rotation``: the published one (ned_from_body); ``line_ned``: the line by it (unit). Its satellites watch a baseline where no third
    antenna does: the truth is within the baseline's levels of its vector, so within the angle that these are seen under; what separates
    the published line from that vector is added. The turn about the line is as level as the body. An antenna whose satellites are all
    wrong alike is not covered.
    """
    turn, length_m = angles_per_error(rotation), float(np.linalg.norm(told.vector_ned_m))
    off = np.abs(turn @ np.cross(line_ned, told.vector_ned_m)) / length_m
    arms = np.cross(turn, told.vector_ned_m) / length_m**2
    reach = np.hypot(arms[:, 0], arms[:, 1]) * told.horizontal_m + np.abs(arms[:, 2]) * told.vertical_m
    level = np.abs(turn @ line_ned) * widening(1.0, _RARE * guarding.risk) * guarding.unseen_sigma_rad
    bounded = reach < 1.0  # NaN: nothing was told
    return np.where(bounded, off + np.arcsin(np.where(bounded, reach, 0.0)) + level, inf)


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
    unseen = np.zeros(3) if found.unseen_ned is None else found.unseen_ned
    turn, cov = angles_per_error(found.ned_from_body), plain(found.cov[:3, :3])
    return widening(1.0, 0.5 * guarding.risk) * inflated_sigmas(turn, cov, unseen, INFLATION, guarding.unseen_sigma_rad)


def _bounds(layout: Layout, measured: Measured, found: Fit, asked: Sequence[_Hypothesis], share: float, guarding: Guarding) -> Matrix:
    """Return how far angles (h, 3) may be off under each hypothesis; infinite where no other attitude is left."""
    origin, rotation = found.origin_ned_m if measured.absolute else np.empty(0), plain(found.ned_from_body)
    said = plain(measured.weights), plain(layout.positions_m), plain(measured.values_ned_m), plain(measured.cov_m2)
    told = normal_equations(*said, layout.covariance_m2, rotation, origin)
    sets = np.full((len(asked), max(len(gone) for _, gone in asked)), -1)
    for row, (_, gone) in enumerate(asked):
        sets[row, : len(gone)] = gone
    scales, turn = np.array([widening(prior, share) for prior, _ in asked]), angles_per_error(rotation)
    return bounds_without(told, len(layout.names), sets, scales, rotation, turn, INFLATION, guarding.unseen_sigma_rad)
