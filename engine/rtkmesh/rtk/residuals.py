"""Single differences: what rover and base observed, minus the models of each at its own time.

The models are undifferenced (``rtkmesh.models.geometry``), so a base epoch of another time needs nothing special.
"""

from dataclasses import dataclass, fields
from math import isfinite
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.gnss.constants import SPEED_OF_LIGHT_MPS
from rtkmesh.gnss.epoch import HALF_CYCLE, SLIP, Epoch
from rtkmesh.gnss.signals import GLONASS, NO_CHANNEL, carrier_hz
from rtkmesh.models.ephemeris_table import IODE, TOE_TOW, TOE_WEEK, EphemerisTable
from rtkmesh.models.geometry import AZIMUTH, E_X, E_Z, ELEVATION, GEOMETRY, IONOSPHERE_L1_M, RANGE, TROPOSPHERE_M, receiver_model
from rtkmesh.models.orbit import STATE, STATE_CLOCK, STATE_OK
from rtkmesh.rtk.matching import Pairs, runs
from rtkmesh.rtk.noise import UNALIGNED_CODE_M, cn0_factor, elevation_variance

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]

# Columns of a single difference. CODE and PHASE (m): observed minus modelled, rover minus base, NaN where not to be used; ROVER_PHASE and
# BASE_PHASE (m) the same of one receiver (time differences find slips in them); variances (m2); IONOSPHERE is (f1 / f)^2; CN0 the lower
# of the two. CHANNEL that of GLONASS, 0 for others.
CODE, PHASE, ROVER_PHASE, BASE_PHASE, CODE_VARIANCE, PHASE_VARIANCE, WAVELENGTH, IONOSPHERE, CN0, ELEVATION_RAD, CHANNEL = range(11)
DIFFERENCE: Final = 11

# Places in the vector of noise parameters.
PHASE_A, PHASE_B, CODE_RATIO, COMMON_VARIANCE = range(4)

_L1_HZ = 1575.42e6
_C = SPEED_OF_LIGHT_MPS


@kernel
def wavelengths(satellite: NDArray[np.int16], signal: NDArray[np.int16], channel: NDArray[np.int8], out: Vector) -> None:
    """Write the wavelength (m) per row; NaN where the carrier is not known."""
    for k in range(len(satellite)):
        f = carrier_hz(int(satellite[k]), int(signal[k]), int(channel[k]))
        out[k] = _C / f if f > 0.0 else np.nan


@kernel
def undifferenced(
    rows: Indices, satellite_index: Indices, wavelength_m: Vector, pseudorange_m: Vector, phase_cyc: Vector, flags: NDArray[np.uint8],
    states: Matrix, geometry: Matrix, out: Matrix,
) -> None:  # fmt: skip
    """Write code and phase (m) minus model of one receiver per pair (n x 2); NaN where not observed or not to be modelled."""
    for k in range(len(rows)):
        row, s = rows[k], satellite_index[k]
        out[k, 0], out[k, 1] = np.nan, np.nan
        if states[s, STATE_OK] == 0.0:
            continue
        model = geometry[s, RANGE] - _C * states[s, STATE_CLOCK] + geometry[s, TROPOSPHERE_M]
        scale = wavelength_m[k] * _L1_HZ / _C
        delay = geometry[s, IONOSPHERE_L1_M] * scale * scale
        if not isfinite(delay):
            continue
        out[k, 0] = pseudorange_m[row] - model - delay
        if flags[row] & HALF_CYCLE == 0:
            out[k, 1] = phase_cyc[row] * wavelength_m[k] - model + delay


@kernel
def single_differences(
    satellite_index: Indices,
    likeness: Indices,
    wavelength_m: Vector,
    rover: Matrix,
    base: Matrix,
    rover_cn0_dbhz: Vector,
    base_cn0_dbhz: Vector,
    rover_sigma: Matrix,
    base_sigma: Matrix,
    elevation_rad: Vector,
    mask_rad: float,
    noise: Vector,
    out: Matrix,
) -> None:
    """Write the single differences (n x DIFFERENCE) of the pairs.

    ``rover`` and ``base`` (n x 2) are of ``undifferenced``; the sigmas (n x 2) are those that the receivers report: code (m), phase
    (cycles), NaN if they do not; ``noise`` is the vector of parameters.
    """
    for k in range(len(satellite_index)):
        elevation = float(elevation_rad[satellite_index[k]])
        cn0 = min(rover_cn0_dbhz[k], base_cn0_dbhz[k]) if base_cn0_dbhz[k] > 0.0 else rover_cn0_dbhz[k]
        scale = wavelength_m[k] * _L1_HZ / _C
        out[k, WAVELENGTH], out[k, IONOSPHERE] = wavelength_m[k], scale * scale
        out[k, ROVER_PHASE], out[k, BASE_PHASE] = rover[k, 1], base[k, 1]
        out[k, CN0], out[k, ELEVATION_RAD] = cn0, elevation
        usable = elevation >= mask_rad
        out[k, CODE] = rover[k, 0] - base[k, 0] if usable else np.nan
        out[k, PHASE] = rover[k, 1] - base[k, 1] if usable else np.nan
        factor = elevation_variance(noise[PHASE_A], noise[PHASE_B], elevation)
        factor *= cn0_factor(rover_cn0_dbhz[k]) + cn0_factor(base_cn0_dbhz[k])
        code, phase = factor * noise[CODE_RATIO] ** 2, factor
        for sigmas in (rover_sigma, base_sigma):
            if sigmas[k, 0] > 0.0:
                code += sigmas[k, 0] ** 2
            if sigmas[k, 1] > 0.0:
                phase += (sigmas[k, 1] * wavelength_m[k]) ** 2
        if likeness[k] == 2:
            code += UNALIGNED_CODE_M**2
        common = noise[COMMON_VARIANCE] / max(np.sin(elevation), 0.2) ** 2
        out[k, CODE_VARIANCE] = code + common
        out[k, PHASE_VARIANCE] = phase + common


@kernel
def receiver_elevations(geometry: Matrix, out: Vector) -> None:
    """Copy the elevations (rad), with -1 where a satellite has none."""
    for i in range(geometry.shape[0]):
        out[i] = geometry[i, ELEVATION] if isfinite(geometry[i, ELEVATION]) else -1.0


@dataclass(frozen=True, slots=True, eq=False)
class Differences:
    """The single differences of one pair of epochs; all columns go with ``pairs``.

    ``table`` is of ``single_differences``; directions are unit vectors receiver to satellite; ``issue`` names the ephemeris; ``flagged``
    (n x 2) says that the rover or the base reports a slip; ``half_cycle`` that either has its half cycles open; ``lock_s`` (n x 2) are
    rover's and base's; ``base_s`` is the time of the base epoch (on the filter's clock).
    """

    pairs: Pairs
    table: Matrix
    rover_direction: Matrix
    base_direction: Matrix
    azimuth_rad: Vector
    issue: Vector
    flagged: NDArray[np.bool_]
    half_cycle: NDArray[np.bool_]
    lock_s: Matrix
    base_s: Vector


@dataclass(frozen=True, slots=True)
class Conditions:
    """What of an epoch decides variances and use: noise parameters, elevation mask, time of the base epoch (on the filter's clock)."""

    noise: Vector
    mask_rad: float
    base_s: float


def observe(
    rover: Epoch, base: Epoch, pairs: Pairs, table: EphemerisTable, klobuchar: Vector, rover_ecef_m: Vector, base_ecef_m: Vector,
    conditions: Conditions,
) -> Differences:  # fmt: skip
    """Form the single differences of matched epochs, modelled at these positions.

    Both receivers are modelled with the same issue of each ephemeris, the one that is right for the rover's epoch.
    """
    satellites, first, index = runs(pairs.satellite)
    rows = table.select(satellites, rover.time)
    channel = rover.channel[pairs.rover]
    channel = np.where(channel == NO_CHANNEL, table.channels(pairs.satellite), channel).astype(np.int8)
    wavelength = np.empty(len(pairs))
    wavelengths(pairs.satellite, rover.signal[pairs.rover], channel, wavelength)
    phases: list[Matrix] = []
    geometries: list[Matrix] = []
    for epoch, row, position in ((rover, pairs.rover, rover_ecef_m), (base, pairs.base, base_ecef_m)):
        states, geometry, out = np.empty((len(satellites), STATE)), np.empty((len(satellites), GEOMETRY)), np.empty((len(pairs), 2))
        codes = epoch.pseudorange_m[row[first]]
        receiver_model(rows, epoch.time.week, epoch.time.tow_s, codes, position, klobuchar, states, geometry)
        undifferenced(row, index, wavelength, epoch.pseudorange_m, epoch.phase_cyc, epoch.flags, states, geometry, out)
        phases.append(out)
        geometries.append(geometry)
    elevation = np.empty(len(satellites))
    receiver_elevations(geometries[0], elevation)
    out = np.empty((len(pairs), DIFFERENCE))
    single_differences(
        index, pairs.likeness, wavelength, phases[0], phases[1], rover.cn0_dbhz[pairs.rover], base.cn0_dbhz[pairs.base],
        _reported(rover, pairs.rover), _reported(base, pairs.base), elevation, conditions.mask_rad, conditions.noise, out,
    )  # fmt: skip
    out[:, CHANNEL] = np.where((pairs.satellite // 64 == GLONASS) & (channel != NO_CHANNEL), channel, 0)
    flags = np.column_stack((rover.flags[pairs.rover], base.flags[pairs.base]))
    return Differences(
        pairs=pairs,
        table=out,
        rover_direction=np.ascontiguousarray(geometries[0][index, E_X : E_Z + 1]),
        base_direction=np.ascontiguousarray(geometries[1][index, E_X : E_Z + 1]),
        azimuth_rad=geometries[0][index, AZIMUTH],
        issue=_issue(rows)[index],
        flagged=(flags & SLIP) != 0,
        half_cycle=((flags & HALF_CYCLE) != 0).any(axis=1),
        lock_s=np.column_stack((rover.lock_s[pairs.rover], base.lock_s[pairs.base])),
        base_s=np.full(len(pairs), conditions.base_s),
    )


def combine(first: Differences, second: Differences) -> Differences:
    """Return the differences of both, sorted by satellite; they must not share a system."""
    a, b = first.pairs, second.pairs
    satellite = np.concatenate((a.satellite, b.satellite))
    order = np.argsort(satellite, kind="stable")

    def both(x: NDArray[Any], y: NDArray[Any]) -> NDArray[Any]:
        return np.ascontiguousarray(np.concatenate((x, y))[order])

    pairs = Pairs(
        satellite[order], both(a.rover, b.rover), both(a.base, b.base), both(a.likeness, b.likeness), both(a.group, b.group + a.groups),
        a.groups + b.groups, both(a.key, b.key),
    )  # fmt: skip
    columns = {f.name: both(getattr(first, f.name), getattr(second, f.name)) for f in fields(Differences) if f.name != "pairs"}
    return Differences(pairs=pairs, **columns)


def _reported(epoch: Epoch, row: Indices) -> Matrix:
    return np.column_stack((epoch.pseudorange_sigma_m[row], epoch.phase_sigma_cyc[row]))


def _issue(rows: Matrix) -> Vector:
    """Return a number that changes when another issue of the ephemeris is taken."""
    return rows[:, TOE_WEEK] * 1.0e6 + rows[:, TOE_TOW] + rows[:, IODE] * 1e-3
