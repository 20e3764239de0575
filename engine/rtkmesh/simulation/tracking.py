"""Kernels of a simulated receiver: signal paths, tracking loops with their faults, and the measurements they give."""

from math import cos, exp, sin, sqrt
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.gnss.constants import GPS_L1_HZ, OMEGA_EARTH_GPS_RADPS, SPEED_OF_LIGHT_MPS
from rtkmesh.gnss.epoch import HALF_CYCLE, SLIP
from rtkmesh.gnss.signals import GLONASS, SATELLITES_PER_SYSTEM
from rtkmesh.models.ephemeris_table import SATELLITE
from rtkmesh.models.geometry import E_X, E_Y, E_Z, ELEVATION, IONOSPHERE_L1_M, RANGE, TROPOSPHERE_M, line_of_sight, receiver_geometry
from rtkmesh.models.orbit import STATE_CLOCK, STATE_CLOCK_RATE, STATE_OK, group_delay_m, satellite_state
from rtkmesh.simulation.surroundings import ATTENUATION_DB, CODE_SIGMA_M, EXTRA_M, EXTRA_RATE_MPS, PATH, PHASE_SIGMA_M

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Cube = NDArray[np.float64]

SLOTS: Final = 2  # signals per satellite

# Columns of a tracking state (satellites, SLOTS, TRACK): time when the signal is acquired and since when its phase is continuous (s; NaN:
# not tracked), ambiguity (cycles), half cycle not yet removed (0 or 1), multipath of code and phase that comes and goes within seconds and
# within minutes, and fading (unit variance each), slipped just now, way that the signal takes (PATH of the surroundings).
READY, SINCE, AMBIGUITY, HALF, CODE_FAST, PHASE_FAST, CODE_SLOW, PHASE_SLOW, FADING, SLIPPED, WAY = range(11)
TRACK: Final = 11
NORMALS: Final = 9  # random numbers per signal and epoch
UNIFORMS: Final = 4

# Rows of the measured values.
PSEUDORANGE, PHASE, DOPPLER, CN0, LOCK, CODE_SIGMA, PHASE_SIGMA = range(7)
VALUES: Final = 7

_C = SPEED_OF_LIGHT_MPS
_OMEGA = OMEGA_EARTH_GPS_RADPS
_REFERENCE_CN0 = 45.0  # dB-Hz at which the sigmas of the options hold
_WARM_LOCK_S = 60.0
_SECOND_SIGNAL_DELAY_S = 1.0  # the second frequency is acquired after the first
_GLONASS_CODES = 1.6  # how much larger errors of GLONASS codes are, of chips twice as long: recordings show 1.0 to 1.9
_LOWEST_SINE = 0.1  # of elevations, where multipath stops to grow
_WEAK_CN0_DBHZ = 28.0  # our choice: about where the phase loops of robots' receivers begin to slip
_WEAK_SLOPE_DB = 2.5  # our choice: tenfold slips for so many dB less (the mean time to a slip is exponential in the loop's noise)


class SignalOptions(NamedTuple):
    """How well a receiver tracks. ``code_sigma_m`` and ``phase_sigma_m`` are white, at 45 dB-Hz, and go with C/N0.

    Multipath is what else codes and phases have of errors, whatever its cause: its sigma at the zenith, which grows as 1 / sin(elevation).
    Of its squares ``slow`` and ``lasting`` are shares that live for ``multipath_slow_s`` and for ever, the rest for ``multipath_fast_s``.
    The defaults are those of a u-blox ZED-F9P (see ``classes``).
    """

    code_sigma_m: float = 0.05
    phase_sigma_m: float = 0.0012
    rate_sigma_mps: float = 0.03
    code_multipath_m: float = 0.27
    phase_multipath_m: float = 0.0021
    code_slow: float = 0.1
    code_lasting: float = 0.1
    phase_slow: float = 0.33
    phase_lasting: float = 0.22
    multipath_fast_s: float = 25.0
    multipath_slow_s: float = 90.0
    glonass_code_bias_m: float = 0.3  # sigma of what each GLONASS satellite's codes are off for ever
    told_code_sigma_m: float = 0.25  # what the receiver says of its codes at 45 dB-Hz; 0: it says nothing of codes and phases
    fading_sigma_db: float = 1.5
    fading_time_s: float = 8.0
    zenith_cn0_dbhz: float = 47.5
    horizon_cn0_dbhz: float = 30.0
    second_signal_db: float = -4.0
    slips_per_hour: float = 1.0  # of each signal
    half_cycle_share: float = 0.3  # of new arcs and of slips that are wrong by half a cycle until it is resolved
    half_cycle_time_s: float = 3.0  # until the half cycle is resolved
    acquisition_time_s: float = 2.0
    glonass_slopes_m: tuple[float, float] = (0.0, 0.0)  # delay per frequency channel, on either of the two bands
    weak_slips_per_hour: float = 0.0  # of each signal at 28 dB-Hz, tenfold for every 2.5 dB less
    untold_share: float = 0.0  # of slips that the receiver does not notice
    loss_cn0_dbhz: float = 24.0  # an attenuated signal that is weaker is lost


@kernel
def signal_paths(
    rows: Matrix, week: int, tow_s: float, receiver_ecef_m: Vector, velocity_ecef_mps: Vector, klobuchar: Vector,
    travel_s: Vector, states: Matrix, geometry: Matrix, rates_mps: Vector,
) -> None:  # fmt: skip
    """Write states at transmission, geometry (see ``models.geometry``) and rates of range plus troposphere of what arrives at a true time.

    ``travel_s`` (n) holds the travel times: a first guess on entry (that of the epoch before), exact to 1e-12 s on return.
    """
    for i in range(rows.shape[0]):
        for _ in range(8):
            satellite_state(rows[i], week, tow_s - travel_s[i], states[i])
            line_of_sight(states[i], receiver_ecef_m, geometry[i])
            change_s = geometry[i, RANGE] / _C - travel_s[i]
            travel_s[i] += change_s
            if abs(change_s) < 1e-10:  # the satellite moves less than 1 um meanwhile
                break
        states[i, STATE_OK] = 1.0
    receiver_geometry(states, week, tow_s, receiver_ecef_m, klobuchar, geometry)
    for i in range(rows.shape[0]):
        rates_mps[i] = range_rate_mps(states[i], geometry[i], velocity_ecef_mps)
        rates_mps[i] += _troposphere_rate_mps(states[i], geometry[i], receiver_ecef_m)


@kernel
def range_rate_mps(state: Vector, geometry: Vector, velocity_ecef_mps: Vector) -> float:
    """Return the change of the geometric range per second of reception.

    The derivative of |R(omega tau) s(t - tau) - r(t)| with the flight time's own change; R turns by the earth's rotation.
    """
    angle = _OMEGA * geometry[RANGE] / _C
    vx = state[3] * cos(angle) + state[4] * sin(angle)
    vy = state[4] * cos(angle) - state[3] * sin(angle)
    towards = geometry[E_X] * vx + geometry[E_Y] * vy + geometry[E_Z] * state[5]
    own = geometry[E_X] * velocity_ecef_mps[0] + geometry[E_Y] * velocity_ecef_mps[1] + geometry[E_Z] * velocity_ecef_mps[2]
    # derivative of the turn: e . (omega x s) per second of flight time
    turning = _OMEGA * (geometry[E_X] * state[1] - geometry[E_Y] * state[0])
    return (towards - own) / (1.0 + (towards - turning) / _C)


@kernel
def _troposphere_rate_mps(state: Vector, geometry: Vector, receiver_ecef_m: Vector) -> float:
    """Return the change of the tropospheric delay per second by the satellite's motion, as if it went with 1 / sin(elevation)."""
    radius = sqrt(receiver_ecef_m[0] ** 2 + receiver_ecef_m[1] ** 2 + receiver_ecef_m[2] ** 2)
    sine, along, climb = 0.0, 0.0, 0.0
    for k in range(3):
        up = receiver_ecef_m[k] / radius
        sine += geometry[E_X + k] * up
        along += geometry[E_X + k] * state[3 + k]
        climb += up * state[3 + k]
    return -geometry[TROPOSPHERE_M] * (climb - along * sine) / geometry[RANGE] / max(sine, 0.05)


@kernel
def update_tracking(
    track: Cube, geometry: Matrix, view: Matrix, time_s: float, step_s: float, lowest_rad: float, warm: bool,
    options: SignalOptions, normals: Cube, uniforms: Cube, notices: Matrix,
) -> None:  # fmt: skip
    """Move the tracking state (n, SLOTS, TRACK) to the next epoch: acquire, lose, slip, fade; ``step_s`` is 0 at the first.

    ``view`` (n, VIEW) is what the surroundings do; ``notices`` (n, SLOTS), uniform, decides whether a slip is told.
    """
    for i in range(track.shape[0]):
        for j in range(SLOTS):
            state, chance = track[i, j], uniforms[i, j]
            fading = 0.0 if np.isnan(state[SINCE]) else state[FADING]
            cn0_dbhz = _cn0_dbhz(geometry[i, ELEVATION], j, fading, options) - view[i, ATTENUATION_DB]
            lost = view[i, ATTENUATION_DB] > 0.0 and cn0_dbhz < options.loss_cn0_dbhz
            if geometry[i, ELEVATION] < lowest_rad or lost:
                state[READY], state[SINCE] = np.nan, np.nan
                continue
            if np.isnan(state[READY]):
                wait_s = options.acquisition_time_s * (0.5 + chance[0]) + _SECOND_SIGNAL_DELAY_S * j
                state[READY] = time_s if warm else time_s + wait_s
            if time_s < state[READY]:
                continue
            if np.isnan(state[SINCE]):
                _begin_arc(state, time_s, warm, options, normals[i, j], chance)
            else:
                weak = 10.0 ** ((_WEAK_CN0_DBHZ - cn0_dbhz) / _WEAK_SLOPE_DB) if options.weak_slips_per_hour > 0.0 else 0.0
                slips = (options.slips_per_hour + options.weak_slips_per_hour * weak) * step_s / 3600.0
                other_way = state[WAY] != view[i, PATH]
                _continue_arc(state, time_s, step_s, slips, other_way, notices[i, j], options, normals[i, j], chance)
            state[WAY] = view[i, PATH]


@kernel
def _begin_arc(state: Vector, time_s: float, warm: bool, options: SignalOptions, normal: Vector, chance: Vector) -> None:
    state[SINCE] = time_s - _WARM_LOCK_S * (0.1 + chance[1]) if warm else time_s
    state[AMBIGUITY] = np.floor(2000.0 * chance[2]) - 1000.0
    state[HALF] = 1.0 if not warm and chance[3] < options.half_cycle_share else 0.0
    state[CODE_FAST], state[PHASE_FAST], state[FADING] = normal[0], normal[1], normal[2]
    state[CODE_SLOW], state[PHASE_SLOW] = normal[7], normal[8]
    state[SLIPPED] = 0.0 if warm else 1.0


@kernel
def _continue_arc(
    state: Vector, time_s: float, step_s: float, slips: float, other_way: bool, notice: float, options: SignalOptions, normal: Vector,
    chance: Vector,
) -> None:  # fmt: skip
    """Let multipath and fading drift (first order Gauss-Markov, unit variance) and slip: ``slips`` are expected, or certain."""
    state[CODE_FAST] = _drifted(state[CODE_FAST], step_s / options.multipath_fast_s, normal[0])
    state[PHASE_FAST] = _drifted(state[PHASE_FAST], step_s / options.multipath_fast_s, normal[1])
    state[CODE_SLOW] = _drifted(state[CODE_SLOW], step_s / options.multipath_slow_s, normal[7])
    state[PHASE_SLOW] = _drifted(state[PHASE_SLOW], step_s / options.multipath_slow_s, normal[8])
    state[FADING] = _drifted(state[FADING], step_s / options.fading_time_s, normal[2])
    state[SLIPPED] = 0.0
    if chance[0] < slips or other_way:
        size = 1.0 + np.floor(5.0 * chance[2])
        state[AMBIGUITY] += size if chance[1] < 0.5 else -size
        if notice >= options.untold_share:
            state[SINCE], state[SLIPPED] = time_s, 1.0
            state[HALF] = 1.0 if chance[3] < options.half_cycle_share else 0.0


@kernel
def _drifted(value: float, steps: float, normal: float) -> float:
    """Return a Gauss-Markov state of unit variance after a step of so many correlation times."""
    keep = exp(-steps)
    return keep * value + sqrt(1.0 - keep * keep) * normal


@kernel
def _mixed(fast: float, slow: float, lasting: float, slow_share: float, lasting_share: float) -> float:
    """Return an error of unit variance of three independent ones with shares of the squares."""
    return sqrt(1.0 - slow_share - lasting_share) * fast + sqrt(slow_share) * slow + sqrt(lasting_share) * lasting


class Arriving(NamedTuple):
    """What arrives at an antenna, a row per satellite: ephemerides, states at transmission, geometry, rates as ``signal_paths`` has them,
    and what the surroundings do (``around``, VIEW).
    """

    rows: Matrix
    states: Matrix
    geometry: Matrix
    rates_mps: Vector
    around: Matrix


class Tracked(NamedTuple):
    """What a receiver tracks: tracking states; signals (-1: none) and carriers by satellite and slot, channels; biases of codes and phases
    by system and slot; what codes and phases keep of multipath and GLONASS codes of their bias (n, SLOTS, 3), unit variance.
    """

    track: Cube
    signals: NDArray[np.int16]
    carriers_hz: Matrix
    channels: NDArray[np.int8]
    code_biases_m: Matrix
    phase_biases_cyc: Matrix
    lasting: Cube


class Measured(NamedTuple):
    """Room for the measurements of an epoch, a column each: ``place`` (satellite row * SLOTS + slot), flags, values (VALUES, .), and where
    a resolved half cycle is subtracted (``halves``).
    """

    place: NDArray[np.int64]
    flags: NDArray[np.uint8]
    halves: NDArray[np.bool_]
    values: Matrix


def room_to_measure(satellites: int) -> Measured:
    """Return room for all signals of so many satellites."""
    n = satellites * SLOTS
    return Measured(np.empty(n, np.int64), np.empty(n, np.uint8), np.empty(n, np.bool_), np.empty((VALUES, n)))


@kernel
def measure(
    arriving: Arriving, tracked: Tracked, clock: tuple[float, float, float], options: SignalOptions, normals: Cube, out: Measured
) -> int:
    """Write all measurements of an epoch and return how many; ``clock``: its reading (s), its offset (s) and rate (s/s)."""
    count = 0
    for i in range(tracked.track.shape[0]):
        for j in range(SLOTS):
            state = tracked.track[i, j]
            if np.isnan(state[SINCE]) or tracked.signals[i, j] < 0:
                continue
            _measure_signal(arriving, tracked, i, j, clock, options, normals[i, j], out.values[:, count])
            resolved = out.values[LOCK, count] >= options.half_cycle_time_s
            out.flags[count] = (0 if resolved else HALF_CYCLE) | (SLIP if state[SLIPPED] > 0.0 else 0)
            out.halves[count] = resolved and state[HALF] > 0.0
            out.place[count] = i * SLOTS + j
            count += 1
    return count


@kernel
def _measure_signal(
    arriving: Arriving, tracked: Tracked, i: int, j: int, clock: tuple[float, float, float], options: SignalOptions, normal: Vector,
    out: Vector,
) -> None:  # fmt: skip
    """Write the values of one signal (slot j of satellite i)."""
    state, geometry, around, system = tracked.track[i, j], arriving.geometry[i], arriving.around[i], _system_of(arriving, i)
    slope_m = options.glonass_slopes_m[j] * tracked.channels[i] if system == GLONASS else 0.0
    common_m = geometry[RANGE] + _C * (clock[1] - arriving.states[i, STATE_CLOCK]) + geometry[TROPOSPHERE_M] + slope_m
    common_m += around[EXTRA_M]
    ionosphere_m = geometry[IONOSPHERE_L1_M] * (GPS_L1_HZ / tracked.carriers_hz[i, j]) ** 2
    out[CN0] = _cn0_dbhz(geometry[ELEVATION], j, state[FADING], options) + 0.4 * normal[3]
    out[CN0] -= around[ATTENUATION_DB]
    noise = 10.0 ** ((_REFERENCE_CN0 - out[CN0]) / 20.0)
    code_m, phase_m = _errors_m(arriving, tracked, i, j, noise, options, normal)
    delay_m = group_delay_m(arriving.rows[i], tracked.signals[i, j]) + tracked.code_biases_m[system, j]
    out[PSEUDORANGE] = common_m + ionosphere_m + delay_m + code_m
    out[LOCK], wavelength_m = clock[0] - state[SINCE], _C / tracked.carriers_hz[i, j]
    half_cyc = 0.0 if out[LOCK] >= options.half_cycle_time_s else 0.5 * state[HALF]
    cycles = (common_m - ionosphere_m + phase_m) / wavelength_m
    out[PHASE] = cycles + state[AMBIGUITY] + half_cyc + tracked.phase_biases_cyc[system, j]
    rate_mps = arriving.rates_mps[i] + _C * (clock[2] - arriving.states[i, STATE_CLOCK_RATE]) + options.rate_sigma_mps * noise * normal[6]
    rate_mps += around[EXTRA_RATE_MPS]
    out[DOPPLER] = -rate_mps / wavelength_m
    says, wide = options.told_code_sigma_m > 0.0, _GLONASS_CODES if system == GLONASS else 1.0
    out[CODE_SIGMA] = options.told_code_sigma_m * wide * noise if says else np.nan
    out[PHASE_SIGMA] = options.phase_sigma_m * noise / wavelength_m if says else np.nan


@kernel
def _errors_m(
    arriving: Arriving, tracked: Tracked, i: int, j: int, noise: float, options: SignalOptions, normal: Vector
) -> tuple[float, float]:
    """Return the errors of a code and a phase: noise, multipath, reflections, and of GLONASS codes their bias."""
    state, lasting, around = tracked.track[i, j], tracked.lasting[i, j], arriving.around[i]
    low = 1.0 / max(sin(arriving.geometry[i, ELEVATION]), _LOWEST_SINE)
    code_own = _mixed(state[CODE_FAST], state[CODE_SLOW], lasting[0], options.code_slow, options.code_lasting)
    code_m = options.code_sigma_m * noise * normal[4] + options.code_multipath_m * low * code_own
    code_m += around[CODE_SIGMA_M] * state[CODE_FAST]
    if _system_of(arriving, i) == GLONASS:
        code_m = _GLONASS_CODES * code_m + options.glonass_code_bias_m * lasting[2]
    phase_own = _mixed(state[PHASE_FAST], state[PHASE_SLOW], lasting[1], options.phase_slow, options.phase_lasting)
    phase_m = options.phase_sigma_m * noise * normal[5] + options.phase_multipath_m * low * phase_own
    return code_m, phase_m + around[PHASE_SIGMA_M] * state[PHASE_FAST]


@kernel
def _system_of(arriving: Arriving, i: int) -> int:
    """Return the system of a satellite."""
    return int(arriving.rows[i, SATELLITE]) // SATELLITES_PER_SYSTEM


@kernel
def _cn0_dbhz(elevation_rad: float, slot: int, fading: float, options: SignalOptions) -> float:
    span = options.zenith_cn0_dbhz - options.horizon_cn0_dbhz
    open_sky = options.horizon_cn0_dbhz + span * max(sin(elevation_rad), 0.0) ** 0.7
    return max(open_sky + options.second_signal_db * slot + options.fading_sigma_db * fading, 20.0)
