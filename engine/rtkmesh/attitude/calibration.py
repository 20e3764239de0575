"""Calibration of an antenna layout: body-frame positions with joint covariance from many instants of fixed baselines or positions.

Static or moving, any mix of pairs: distances and shape do not depend on the attitude. Wrong fixes are screened by distances, then by
chi-square; sigmas are scaled by the residuals, horizontally and vertically; noise that is correlated in time is taken into the
covariance. Errors that turn with the body and never change (phase centres, multipath of the mast on a body that stands still) are not
seen by any of this. Source: seed_systems.md 3.3, "Calibration".
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import asin, atan2, nan, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.attitude.adjustment import Adjusted, adjusted, axis_scales
from rtkmesh.attitude.calibration_frame import Axes, defined_axes, in_axes
from rtkmesh.attitude.calibration_screen import Distances, Pair, distances, start_places, usable, without_wrong, wrong_pairs
from rtkmesh.attitude.chi_square import chi_square_limit
from rtkmesh.attitude.colour import autocorrelation, coloured_cov, correlation_factor
from rtkmesh.attitude.rigid_body import Layout, Measured, Shape, shape_of
from rtkmesh.errors import OptionError

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

WITHIN_M: Final = 0.05
_FALSE_ALARM: Final = 1e-4  # per instant, of the chi-square screen
_STRAIGHT: Final = 0.02  # antennas that are off a line by less than this share of its length are taken to be on it
_FEW: Final = 20
_LONG: Final = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Instant:
    """What was measured at one time (s, of any one scale)."""

    time_s: float
    measured: Measured


@dataclass(frozen=True, slots=True)
class Consistency:
    """How the distance of two antennas repeats. ``within_pct``: share of the instants less than 5 cm from the median, nothing screened;
    ``sd_m`` and ``correlation_s`` (how long errors stay alike) are of those that were used; ``told_m`` the sigma that the input claims.
    """

    names: tuple[str, str]
    mean_m: float
    sd_m: float
    told_m: float
    count: int
    used: int
    within_pct: float
    lag_one: float
    correlation_s: float


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """A layout with joint covariance, and how consistent it is with what was measured.

    ``reduced`` instants lost an antenna of wrong distances, ``wrong_distance`` and ``wrong_chi_square`` were not used at all. ``scale_*``:
    by how much errors are larger than told (NaN: not seen). ``variance_factor``: of the coordinates, for noise that is correlated in time.
    ``thickness_m``: largest distance off the best plane, with sigma. ``mean_pitch_rad``, ``mean_roll_rad``: of the axes, over the instants.
    """

    layout: Layout
    shape: Shape
    distances: tuple[Consistency, ...]
    instants: int
    used: int
    reduced: int
    wrong_distance: int
    wrong_chi_square: int
    scale_horizontal: float
    scale_vertical: float
    chi_square: float
    degrees: int
    variance_factor: float
    thickness_m: float
    thickness_sigma_m: float
    mean_pitch_rad: float
    mean_roll_rad: float
    notes: tuple[str, ...]

    @property
    def sigmas_m(self) -> Matrix:
        """Sigmas (n, 3) of the positions; those that the definition of the axes holds fixed are zero."""
        assert self.layout.cov_m2 is not None
        return np.sqrt(np.maximum(np.diag(self.layout.cov_m2), 0.0)).reshape(-1, 3)

    def mounted(self, vehicle_from_axes: Matrix) -> "Calibration":
        """Return it in the vehicle's axes: ``vehicle_from_axes`` (3x3) is exact."""
        assert self.layout.cov_m2 is not None
        wide = np.kron(np.eye(len(self.layout.names)), vehicle_from_axes)
        places = self.layout.positions_m @ vehicle_from_axes.T
        return replace(self, layout=Layout(self.layout.names, places, wide @ self.layout.cov_m2 @ wide.T))

    def shifted(self, offset_m: tuple[float, float, float]) -> "Calibration":
        """Return it with another origin: ``offset_m`` is where the present one is in the new axes."""
        return replace(self, layout=replace(self.layout, positions_m=self.layout.positions_m + np.array(offset_m)))


def calibrate(names: tuple[str, ...], instants: Sequence[Instant], *, centred: bool = False) -> Calibration:
    """Return the layout of antennas; ``instants`` measure mixes of them, in the order of ``names``.

    Axes: origin antenna 1 (``centred``: the centroid), x through antenna 2, z down and normal to the plane of the first three that are
    not on one line. OptionError where there is too little to tell.
    """
    if len(names) < 2:
        raise OptionError("a layout has two antennas or more")
    ordered = sorted(instants, key=lambda instant: instant.time_s)
    whole = distances([instant.measured for instant in ordered], len(names))
    kept, reduced = _screened(ordered, wrong_pairs(whole))
    if len(kept) < 2:
        raise OptionError(f"{len(kept)} of {len(ordered)} instants have two antennas or more whose distances agree: too few")
    found, good, scales = _robust(names, kept)
    return _report(names, found, good, scales, whole, (len(ordered), len(kept), reduced), None if centred else 0)


def _screened(instants: list[Instant], wrong: dict[int, list[Pair]]) -> tuple[list[Instant], int]:
    """Return the instants without antennas of wrong distances, and how many lost one."""
    kept, reduced = list[Instant](), 0
    for i, instant in enumerate(instants):
        left = without_wrong(instant.measured, wrong[i]) if i in wrong else instant.measured if usable(instant.measured) else None
        if left is not None:
            kept.append(Instant(instant.time_s, left))
            reduced += i in wrong
    return kept, reduced


def _robust(names: tuple[str, ...], kept: list[Instant]) -> tuple[Adjusted, list[Instant], tuple[float, float]]:
    """Return the adjustment of the instants that pass the chi-square screen, with scaled sigmas; which, and the scales."""
    good, scales = kept, (1.0, 1.0)
    start, basis = _start(names, good)
    found = adjusted([instant.measured for instant in good], start, basis)
    for _ in range(2):
        passing = _passing(found)
        if int(passing.sum()) < 2:
            raise OptionError("the instants contradict each other: no two agree on a layout")
        good = [instant for instant, ok in zip(good, passing, strict=True) if ok]
        found = adjusted([instant.measured for instant in good], found.places_m, basis)
        scale = axis_scales(found)
        scales = scales[0] * scale[0], scales[1] * scale[1]
        good = [Instant(instant.time_s, _scaled(instant.measured, scale)) for instant in good]
        found = adjusted([instant.measured for instant in good], found.places_m, basis)
    if not found.converged:
        raise OptionError("the layout does not converge: are the antennas in the right order, and on one rigid body?")
    return found, good, scales


def _start(names: tuple[str, ...], instants: list[Instant]) -> tuple[Matrix, Matrix]:
    """Return a rough layout and the directions in which antennas are free: all, or along their line if they are on one."""
    measured = [instant.measured for instant in instants]
    typical = np.zeros(len(measured))
    for series in distances(measured, len(names)).values():
        np.maximum.at(typical, series.at, np.abs(series.length_m - np.median(series.length_m)))
    places = start_places(measured, typical.tolist(), names)
    if not _straight(places):
        return places, np.eye(3 * len(names))
    free = places - places.mean(axis=0)
    direction = np.linalg.svd(free)[2][0]
    along = free @ (direction * np.sign(direction @ (places[1] - places[0])))
    on_line: Matrix = np.zeros_like(places)
    on_line[:, 0] = along - along[0]
    return on_line, _forward_only(len(names))


def _forward_only(antennas: int) -> Matrix:
    """Return the directions (3n, n) of moves along the first axis."""
    return np.eye(3 * antennas)[:, ::3]


def _straight(places: Matrix) -> bool:
    singular = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
    return len(places) < 3 or float(singular[1]) < _STRAIGHT * float(singular[0])


def _passing(found: Adjusted) -> NDArray[np.bool_]:
    """Return which instants agree with the layout, for sigmas scaled so that the middle one is as it should be."""
    degrees = np.maximum(found.degrees, 1)
    middle = degrees * (1.0 - 2.0 / (9.0 * degrees)) ** 3  # the median of chi-square (Wilson and Hilferty)
    has = found.degrees > 0
    scale = max(float(np.median(found.chi_squares[has] / middle[has])), 1e-12) if has.any() else 1.0
    limits = {int(d): chi_square_limit(_FALSE_ALARM, int(d)) for d in np.unique(degrees)}
    return ~has | (found.chi_squares <= scale * np.array([limits[int(d)] for d in degrees]))


def _scaled(measured: Measured, scale: tuple[float, float]) -> Measured:
    horizontal, vertical = scale
    axes = np.tile([horizontal, horizontal, horizontal if np.isnan(vertical) else vertical], len(measured.weights))
    return replace(measured, cov_m2=measured.cov_m2 * np.outer(axes, axes))


def _report(
    names: tuple[str, ...],
    found: Adjusted,
    good: list[Instant],
    scales: tuple[float, float],
    whole: dict[Pair, Distances],
    counts: tuple[int, int, int],
    origin: int | None,
) -> Calibration:
    straight = found.scores.shape[1] < 3 * len(names)
    shape = Shape.LINE if straight else shape_of(found.places_m)
    down = np.mean(np.concatenate([group.rotation[:, 2, :] for group in found.groups]), axis=0)
    axes = defined_axes(found.places_m, shape, down)
    cov, factor = _cov(found, names, straight=straight)
    layout = Layout(names, *in_axes(found.places_m, cov, axes, origin))
    pitch, roll = _tilt(axes, down)
    thickness = _thickness(layout)
    degrees = int(found.degrees.sum()) - int(np.linalg.matrix_rank(found.information, tol=1e-9 * np.trace(found.information)))
    series = _consistency(names, whole, good)
    return Calibration(
        layout=layout,
        shape=shape,
        distances=series,
        instants=counts[0],
        used=len(good),
        reduced=counts[2],
        wrong_distance=counts[0] - counts[1],
        wrong_chi_square=counts[1] - len(good),
        scale_horizontal=scales[0],
        scale_vertical=scales[1],
        chi_square=float(found.chi_squares.sum()),
        degrees=degrees,
        variance_factor=factor,
        thickness_m=thickness[0],
        thickness_sigma_m=thickness[1],
        mean_pitch_rad=pitch,
        mean_roll_rad=roll,
        notes=_notes(shape, len(names), scales, good, series),
    )


def _cov(found: Adjusted, names: tuple[str, ...], *, straight: bool) -> tuple[Matrix, float]:
    """Return the covariance (3n, 3n) in the adjustment's axes, and its largest factor for correlated noise."""
    cov, factor = coloured_cov(found.information, found.scores)
    if not straight:
        return cov, factor
    basis = _forward_only(len(names))
    return basis @ cov @ basis.T, factor


def _tilt(axes: Axes, down: Vector) -> tuple[float, float]:
    """Return mean pitch and roll (rad) of the defined axes."""
    x, y, z = (axes.rotation @ down / np.linalg.norm(down)).tolist()
    return -asin(min(1.0, max(-1.0, x))), atan2(y, z)


def _thickness(layout: Layout) -> tuple[float, float]:
    """Return the largest distance of an antenna off the best plane, with sigma; NaN where every layout is flat."""
    if len(layout.names) < 4 or _straight(layout.positions_m) or layout.cov_m2 is None:
        return nan, nan
    centred = layout.positions_m - layout.positions_m.mean(axis=0)
    flat, _, vt = np.linalg.svd(centred, full_matrices=False)
    off = centred @ vt[2]
    worst = int(np.argmax(np.abs(off)))
    plane = np.column_stack([np.ones(len(off)), flat[:, :2]])
    leverage = np.eye(len(off)) - plane @ np.linalg.pinv(plane)
    row = np.einsum("n,i->ni", leverage[worst], vt[2]).ravel()
    return float(abs(off[worst])), sqrt(max(float(row @ layout.cov_m2 @ row), 0.0))


def _consistency(names: tuple[str, ...], whole: dict[Pair, Distances], good: list[Instant]) -> tuple[Consistency, ...]:
    used = distances([instant.measured for instant in good], len(names))
    step_s = float(np.median(np.diff([instant.time_s for instant in good]))) if len(good) > 1 else 0.0
    empty = Distances()
    return tuple(_consistent((names[i], names[j]), series, used.get((i, j), empty), step_s) for (i, j), series in whole.items())


def _consistent(names: tuple[str, str], series: Distances, used: Distances, step_s: float) -> Consistency:
    everything, lengths = series.length_m, used.length_m
    within = np.abs(everything - np.median(everything)) < WITHIN_M
    enough = len(lengths) > 2
    return Consistency(
        names=names,
        mean_m=float(lengths.mean()) if len(lengths) else nan,
        sd_m=float(lengths.std(ddof=1)) if enough else nan,
        told_m=float(np.median(series.sigma_m)),
        count=len(everything),
        used=len(lengths),
        within_pct=100.0 * float(within.mean()),
        lag_one=float(autocorrelation(lengths)[1]) if enough else nan,
        correlation_s=step_s * correlation_factor(lengths) if enough else nan,
    )


def _notes(
    shape: Shape, antennas: int, scales: tuple[float, float], good: list[Instant], series: tuple[Consistency, ...]
) -> tuple[str, ...]:
    """Return what a user must know of it, in words."""
    span_s = good[-1].time_s - good[0].time_s
    longest_s = max((row.correlation_s for row in series if row.used > 2), default=0.0)
    said = {
        "two antennas: their distance alone is seen; the baseline's elevation and azimuth in the vehicle are not": antennas == 2,
        "the antennas are on one line: what they are off it is not seen, nor will a turn about it be": antennas > 2 and shape is Shape.LINE,
        "three antennas: z is zero by definition, the plane is theirs": antennas == 3 and shape is not Shape.LINE,
        "the heights' sigmas are not tested: rotation and origin swallow them": bool(np.isnan(scales[1])) and antennas > 2,
        f"{len(good)} instants are too few to tell how long errors stay alike: the sigmas take them as independent": len(good) < _FEW,
        f"errors stay alike for {longest_s:.0f} s of {span_s:.0f} s: measure longer": longest_s > _LONG * span_s and len(good) >= _FEW,
    }
    return tuple(text for text, true in said.items() if true)
