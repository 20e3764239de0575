"""What stands around an antenna: buildings that hide, bend and reflect signals, trees that weaken and scatter them.

A view holds, per satellite, what its signals suffer at one place. Everything is a function of seed, place and direction, so that a
vehicle that comes back finds the same walls.
"""

from collections.abc import Callable
from math import cos, exp, log10, pi, sin, sqrt, tan
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

# Columns of a view (satellites, VIEW): loss (dB), what the path is longer than the straight one and its rate (m, m/s), standard
# deviations of multipath of code and phase (m), and the way that the signal takes (0 straight, else a wall that reflects it).
ATTENUATION_DB, EXTRA_M, EXTRA_RATE_MPS, CODE_SIGMA_M, PHASE_SIGMA_M, PATH = range(6)
VIEW: Final = 6

BLOCK_M: Final = 90.0  # from street to street: our choice, as in many European inner cities
STREET_HALF_WIDTH_M: Final = 10.0

_LARGEST_M: Final = 200.0  # walls farther away are below 7 degrees at the heights of here
_STEP_M: Final = 1.0
_HEIGHT_SIGMA: Final = 0.35  # of the logarithm
_OPEN_SHARE: Final = 0.15  # of blocks without buildings: squares and parks
_GRID: Final = 32  # blocks after which the city repeats itself
_L1_M: Final = 0.1903
# Our choice: a wall gives back a third of the amplitude or so, and an antenna for right-handed waves loses a little more on what comes
# back left-handed.
_REFLECTION_DB: Final = 11.0
_COHERENT_M: Final = 15.0  # our choice: a narrow correlator's code follows longer reflections no farther

# The form A = Am (1 - exp(-gamma d / Am)) is that of ITU-R P.833 (attenuation in vegetation); the numbers are our choice for L1.
_FOLIAGE_DB_PER_M: Final = 0.6
_FOLIAGE_LARGEST_DB: Final = 22.0
_CANOPY_M: Final = 14.0  # depth of the crowns of grown trees
_CANOPY_CELL_M: Final = 12.0  # distance of trees
_SCATTER_CODE_M: Final = 2.5  # our choice: under dense canopy, on top of the antenna's own multipath
_SCATTER_PHASE_M: Final = 0.015

# Writes the view (satellites, VIEW) at a place: offset (m) and velocity (m/s) in the site's ENU, azimuths and elevations (rad).
Surroundings = Callable[[Vector, Vector, Vector, Vector, Matrix], None]


def city(seed: int, height_m: float) -> Surroundings:
    """Return straight streets every BLOCK_M in both directions, their crossings at multiples of it, with walls along them.

    ``height_m`` is the median height of the houses: 15 m are five floors.
    """
    rng = np.random.default_rng((seed, 7002))
    heights_m = height_m * np.exp(_HEIGHT_SIGMA * rng.standard_normal((_GRID, _GRID)))
    heights_m[rng.random((_GRID, _GRID)) < _OPEN_SHARE] = 0.0

    def view(offset_enu_m: Vector, velocity_enu_mps: Vector, azimuth_rad: Vector, elevation_rad: Vector, out: Matrix) -> None:
        city_view(heights_m, offset_enu_m, velocity_enu_mps, azimuth_rad, elevation_rad, out)

    return view


def forest(seed: int, density: float) -> Surroundings:
    """Return a stand of trees; ``density`` from 0 (none) to 1 (closed canopy)."""
    phases = np.random.default_rng((seed, 7003)).uniform(0.0, 2.0 * pi, 4)

    def view(offset_enu_m: Vector, _velocity_enu_mps: Vector, azimuth_rad: Vector, elevation_rad: Vector, out: Matrix) -> None:
        forest_view(phases, density, offset_enu_m, azimuth_rad, elevation_rad, out)

    return view


@kernel
def diffraction_db(shadow: float) -> float:
    """Return the loss over a single knife edge (ITU-R P.526); ``shadow`` is its parameter v, positive in the shadow."""
    if shadow <= -0.78:
        return 0.0
    return 6.9 + 20.0 * log10(sqrt((shadow - 0.1) ** 2 + 1.0) + shadow - 0.1)


@kernel
def forest_view(phases: Vector, density: float, offset_enu_m: Vector, azimuth_rad: Vector, elevation_rad: Vector, out: Matrix) -> None:
    """Write the view (n, VIEW) under trees: crowns stand where smooth waves over the pierce point at half the canopy are high."""
    for i in range(out.shape[0]):
        out[i, :] = 0.0
        if elevation_rad[i] <= 0.05:
            continue
        away_m = _CANOPY_M / tan(elevation_rad[i])
        away_m = min(away_m, 60.0)
        east = offset_enu_m[0] + away_m * sin(azimuth_rad[i])
        north = offset_enu_m[1] + away_m * cos(azimuth_rad[i])
        wave = sin(2.0 * pi * east / _CANOPY_CELL_M + phases[0]) * sin(2.0 * pi * north / (1.3 * _CANOPY_CELL_M) + phases[1])
        slow = sin(2.0 * pi * (east + 0.4 * north) / (4.1 * _CANOPY_CELL_M) + phases[2])
        share = min(max(density + 0.35 * wave + 0.25 * slow, 0.0), 1.0) if density > 0.0 else 0.0
        through_m = share * min(_CANOPY_M / sin(elevation_rad[i]), 60.0)
        out[i, ATTENUATION_DB] = _FOLIAGE_LARGEST_DB * (1.0 - exp(-_FOLIAGE_DB_PER_M * through_m / _FOLIAGE_LARGEST_DB))
        part = out[i, ATTENUATION_DB] / _FOLIAGE_LARGEST_DB
        out[i, CODE_SIGMA_M], out[i, PHASE_SIGMA_M] = _SCATTER_CODE_M * part, _SCATTER_PHASE_M * part


@kernel
def city_view(
    heights_m: Matrix, offset_enu_m: Vector, velocity_enu_mps: Vector, azimuth_rad: Vector, elevation_rad: Vector, out: Matrix
) -> None:
    """Write the view (n, VIEW) in a street: knife edges of the roofs, and single reflections by the image method."""
    edge, wall = np.empty(3), np.empty(3)
    for i in range(out.shape[0]):
        out[i, :] = 0.0
        if elevation_rad[i] <= 0.05 or elevation_rad[i] > 1.5:
            continue
        steep, east, north = tan(elevation_rad[i]), sin(azimuth_rad[i]), cos(azimuth_rad[i])
        _roof(heights_m, offset_enu_m, east, north, edge)
        loss_db = 0.0
        if edge[0] > 0.0:
            shadow = (np.arctan(edge[0]) - elevation_rad[i]) * sqrt(2.0 * edge[1] / (cos(elevation_rad[i]) * _L1_M))
            loss_db = diffraction_db(shadow)
        out[i, ATTENUATION_DB] = loss_db
        for axis in range(2):  # walls that run north, walls that run east
            mirrored_east, mirrored_north = (-east, north) if axis == 0 else (east, -north)
            _roof(heights_m, offset_enu_m, mirrored_east, mirrored_north, wall)
            hits = wall[0] > steep and wall[2] == axis
            # after the reflection the ray crosses the street again and must clear the roof that hides the straight one
            clears = edge[0] <= 0.0 or (2.0 * wall[1] + edge[1]) * steep > edge[0] * edge[1]
            if hits and clears:
                across = abs(east) if axis == 0 else abs(north)
                toward_mps = velocity_enu_mps[axis] * np.sign(mirrored_east if axis == 0 else mirrored_north)
                _reflect(out[i], axis, wall[1] * across, across * cos(elevation_rad[i]), toward_mps, loss_db)


@kernel
def _reflect(view: Vector, axis: int, wall_m: float, factor: float, toward_mps: float, loss_db: float) -> None:
    """Take a reflection in: instead of a straight signal that is weaker, else as multipath on it.

    ``wall_m`` is the distance of the wall, ``factor`` the share of twice it by which the path is longer.
    """
    extra_m = 2.0 * wall_m * factor
    if loss_db > _REFLECTION_DB:
        if view[PATH] == 0.0 or extra_m < view[EXTRA_M]:
            view[ATTENUATION_DB], view[EXTRA_M], view[PATH] = _REFLECTION_DB, extra_m, 1.0 + axis
            view[EXTRA_RATE_MPS] = -2.0 * toward_mps * factor
        return
    ratio = 10.0 ** ((loss_db - _REFLECTION_DB) / 20.0)
    # half of the largest error of a code, and a phase error of ratio wavelengths / 2 pi, both as effective values
    view[CODE_SIGMA_M] += 0.35 * ratio * min(extra_m, _COHERENT_M) / 2.0
    view[PHASE_SIGMA_M] += ratio * _L1_M / (2.0 * pi) / sqrt(2.0)


@kernel
def _roof(heights_m: Matrix, offset_enu_m: Vector, east: float, north: float, out: Vector) -> None:
    """Write the steepest roof in a direction: tangent of its elevation, its distance (m), axis of the wall's normal; 0 for none."""
    out[0], out[1], out[2] = 0.0, 0.0, -1.0
    inside_m = -1.0
    for k in range(int(_LARGEST_M / _STEP_M)):
        at_m = k * _STEP_M
        x, y = offset_enu_m[0] + at_m * east, offset_enu_m[1] + at_m * north
        column, row = int(np.floor(x / BLOCK_M)), int(np.floor(y / BLOCK_M))
        left, low = x - column * BLOCK_M, y - row * BLOCK_M
        on_plot = min(left, BLOCK_M - left, low, BLOCK_M - low) > STREET_HALF_WIDTH_M
        if not on_plot:
            inside_m = -1.0
            continue
        if inside_m >= 0.0:
            continue
        # the wall that was crossed in this step: the farther of the two planes of entry along the ray
        first_x = (STREET_HALF_WIDTH_M - left) / east if east > 0.0 else (BLOCK_M - STREET_HALF_WIDTH_M - left) / min(east, -1e-9)
        first_y = (STREET_HALF_WIDTH_M - low) / north if north > 0.0 else (BLOCK_M - STREET_HALF_WIDTH_M - low) / min(north, -1e-9)
        inside_m = max(at_m + max(first_x, first_y), 0.5)
        steep = (heights_m[column % _GRID, row % _GRID] - offset_enu_m[2]) / inside_m
        if steep > out[0]:
            out[0], out[1], out[2] = steep, inside_m, 0.0 if first_x > first_y else 1.0
