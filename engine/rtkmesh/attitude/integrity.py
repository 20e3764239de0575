"""Is an attitude to be believed: chi-square of the rigid fit, which antenna is at fault, and the attitude without it.

The rigid fit sees everything that the distances between antennas see, and more: four antennas of a plane have six distances of rank five,
and a vertical fault that twists the plane shows in the fit alone. What cannot be told apart is said so and not guessed at.
Source: seed_systems.md 3.3 (detection and identification figures); outlier tests as in W. Baarda, "A testing procedure for use in
geodetic networks" (1968).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.attitude.chi_square import chi_square_limit, chi_square_tail
from rtkmesh.attitude.rigid_body import Fit, Layout, Measured, Shape, fit, kabsch
from rtkmesh.gnss.integrity import Integrity

Matrix = NDArray[np.float64]

FALSE_ALARM: Final = 1e-3
_CLEARLY_WORSE: Final = 9.2  # of chi-square: a hundred times less likely
_CERTAIN: Final = 700.0  # a noncentrality that is never missed
_TERMS: Final = 2000


class Finding(StrEnum):
    """What the test of a rigid body found."""

    OK = "ok"
    EXCLUDED = "excluded"
    NO_ATTITUDE = "no attitude"
    NO_REDUNDANCY = "no redundancy"
    NOT_IDENTIFIABLE = "not identifiable"


_INTEGRITY: Final = {
    Finding.OK: Integrity.OK,
    Finding.EXCLUDED: Integrity.OK,
    Finding.NO_ATTITUDE: Integrity.UNAVAILABLE,
    Finding.NO_REDUNDANCY: Integrity.UNAVAILABLE,
    Finding.NOT_IDENTIFIABLE: Integrity.FAILED,
}


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """A fit and what to think of it. ``excluded``: the antennas left out of it; ``suspects``: those of which one may be at fault.

    ``instead``: other exclusions of as many antennas, and by how much larger their chi-squares are.
    """

    fit: Fit | None
    finding: Finding
    excluded: tuple[str, ...] = ()
    suspects: tuple[str, ...] = ()
    instead: tuple[tuple[tuple[str, ...], float], ...] = ()

    @property
    def integrity(self) -> Integrity:
        """OK, failed or unavailable."""
        return _INTEGRITY[self.finding]


def judged(layout: Layout, measured: Measured, start: Matrix | None = None, false_alarm: float = FALSE_ALARM) -> Judged:
    """Return the attitude with a verdict, without the antennas that are found to be at fault.

    ``false_alarm``: probability, per epoch, of finding a fault where there is none. An antenna is excluded when what is left agrees, and no
    other exclusion explains it nearly as well; as many as the redundancy allows, one at a time first.
    """
    whole = fit(layout, measured, start)
    if whole is None:
        return Judged(None, Finding.NO_ATTITUDE)
    if whole.degrees < 1:
        return Judged(whole, Finding.NO_REDUNDANCY)
    if whole.chi_square <= chi_square_limit(false_alarm, whole.degrees):
        return Judged(whole, Finding.OK)
    seen = [int(i) for i in np.flatnonzero(measured.seen)]
    for count in range(1, len(seen) - 2):
        found = _without(layout, measured, whole, list(combinations(seen, count)), false_alarm)
        if found is not None:
            return found
    return Judged(whole, Finding.NOT_IDENTIFIABLE, suspects=_named(layout, seen))


def _without(layout: Layout, measured: Measured, whole: Fit, sets: list[tuple[int, ...]], false_alarm: float) -> Judged | None:
    """Return what excluding one of these sets of antennas says: which, or which ones may be; None when none explains it."""
    fits = [(_fit_without(layout, measured, whole, chosen), chosen) for chosen in sets]
    agreeing = [(f, chosen) for f, chosen in fits if f is not None and f.chi_square <= chi_square_limit(false_alarm, f.degrees)]
    if not agreeing:
        return None
    best, excluded = min(agreeing, key=lambda row: row[0].chi_square)
    worse = {chosen: f.chi_square - best.chi_square for f, chosen in fits if f is not None}
    rivals = [chosen for chosen, more in worse.items() if more < _CLEARLY_WORSE]
    if best.degrees < 1 or len(rivals) > 1:
        return Judged(whole, Finding.NOT_IDENTIFIABLE, suspects=_named(layout, sorted({i for chosen in rivals for i in chosen})))
    instead = tuple((_named(layout, chosen), more) for chosen, more in worse.items() if chosen != excluded)
    return Judged(best, Finding.EXCLUDED, excluded=_named(layout, excluded), instead=instead)


def _named(layout: Layout, antennas: Sequence[int]) -> tuple[str, ...]:
    return tuple(layout.names[i] for i in antennas)


def _fit_without(layout: Layout, measured: Measured, whole: Fit, antennas: tuple[int, ...]) -> Fit | None:
    for antenna in antennas:
        measured = measured.without(antenna)
    left = fit(layout, measured, whole.ned_from_body) if len(measured.weights) else None
    return None if left is None or (left.shape is Shape.LINE and whole.shape is not Shape.LINE) else left


def distance_test(layout: Layout, positions_ned_m: Matrix, cov_m2: Matrix) -> tuple[float, int]:
    """Return chi-square of measured minus known distances between all antennas (n, 3), and its degrees of freedom.

    It needs no attitude, and is blind to what changes no distance at first order: the twist of four antennas of a plane.
    """
    pairs = list(combinations(range(len(positions_ned_m)), 2))
    known = layout.positions_m @ kabsch(layout.positions_m, Measured(np.eye(len(positions_ned_m)), positions_ned_m, cov_m2)).T
    jacobian, misfit = np.zeros((len(pairs), 3 * len(positions_ned_m))), np.empty(len(pairs))
    for row, (i, j) in enumerate(pairs):
        between = known[j] - known[i]
        length = float(np.linalg.norm(between))
        misfit[row] = float(np.linalg.norm(positions_ned_m[j] - positions_ned_m[i])) - length
        jacobian[row, 3 * i : 3 * i + 3], jacobian[row, 3 * j : 3 * j + 3] = -between / length, between / length
    values, vectors = np.linalg.eigh(jacobian @ cov_m2 @ jacobian.T)
    kept = values > 1e-6 * values[-1]
    return float(np.sum((vectors[:, kept].T @ misfit) ** 2 / values[kept])), int(kept.sum())


def detection_power(layout: Layout, measured_cov_m2: Matrix, fault_ned_m: Matrix, rotation: Matrix, false_alarm: float) -> float:
    """Return the probability that the chi-square of positions finds a fault (n, 3) of the antennas.

    ``measured_cov_m2`` (3n, 3n) is of the positions, ``rotation`` is ``ned_from_body``.
    """
    from_fault = Measured(np.eye(len(fault_ned_m)), layout.positions_m @ rotation.T + fault_ned_m, measured_cov_m2)
    found = fit(layout, from_fault)
    return 0.0 if found is None else noncentral_tail(chi_square_limit(false_alarm, found.degrees), found.degrees, found.chi_square)


def noncentral_tail(value: float, degrees: int, noncentrality: float) -> float:
    """Return the probability that a noncentral chi-square exceeds ``value``: its Poisson mixture of central ones (Johnson and Kotz)."""
    if noncentrality > _CERTAIN:
        return 1.0
    term, total = float(np.exp(-0.5 * noncentrality)), 0.0
    for j in range(_TERMS):
        total += term * chi_square_tail(value, degrees + 2 * j)
        term *= 0.5 * noncentrality / (j + 1)
        if term < 1e-12 and j > noncentrality:
            break
    return min(1.0, total)
