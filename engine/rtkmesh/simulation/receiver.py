"""A receiver on an antenna: its clock, its tracking, and an epoch of observations for every time it is asked, in order."""

from dataclasses import dataclass
from math import cos, floor, pi, sin
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.signals import (
    BEIDOU,
    GALILEO,
    GLONASS,
    GPS,
    MAX_SATELLITE,
    SATELLITES_PER_SYSTEM,
    SYSTEMS,
    carrier_hz,
    signal_number,
)
from rtkmesh.gnss.time import GpsTime
from rtkmesh.models.atmosphere import klobuchar_vector
from rtkmesh.models.geometry import AZIMUTH, ELEVATION, GEOMETRY, IONOSPHERE_L1_M, TROPOSPHERE_M
from rtkmesh.models.orbit import STATE
from rtkmesh.simulation.environment import Atmosphere, Window, hidden_below_rad
from rtkmesh.simulation.sky import CHANNELS, KLOBUCHAR, SATELLITES, Sky, absolute_s, glonass_generation
from rtkmesh.simulation.surroundings import VIEW, Surroundings
from rtkmesh.simulation.tracking import (
    CN0,
    CODE_SIGMA,
    DOPPLER,
    LOCK,
    NORMALS,
    PHASE,
    PHASE_SIGMA,
    PSEUDORANGE,
    SLOTS,
    TRACK,
    UNIFORMS,
    Arriving,
    Measured,
    SignalOptions,
    Tracked,
    measure,
    room_to_measure,
    signal_paths,
    update_tracking,
)
from rtkmesh.simulation.trajectories import AntennaPath

_SIGNALS: Final = {GPS: ("1C", "2L"), GALILEO: ("1C", "7Q"), BEIDOU: ("2I", "7I"), GLONASS: ("1C", "2C")}
_WITHOUT_L2C: Final = frozenset((1, 8, 13, 16, 20, 24, 29))  # GPS satellites of the older blocks
_MILLISECOND_S: Final = 1e-3
_WANDER_S: Final = 2e-8
_WANDER_PERIOD_S: Final = 400.0
_TRAVEL_S: Final = 0.08  # first guess of a travel time
_SIGNAL_OPTIONS: Final = SignalOptions()


@dataclass(frozen=True, slots=True)
class ReceiverOptions:
    """One receiver: what it tracks and how its clock runs."""

    signals: SignalOptions = _SIGNAL_OPTIONS
    elevation_mask_rad: float = 0.12
    clock_drift: float = 3e-7  # s/s; the reading is kept within half a millisecond by jumps of one
    steered: bool = False  # the clock is held near GPS time instead
    jumps_at_s: float | None = None  # s from the sky's REFERENCE: one of the jumps comes then; None: whenever the drift brings it
    warm: bool = True  # at the first epoch everything in view is tracked already
    systems: str = "GREC"
    frequencies: int = SLOTS


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """An epoch as measured, what only the receiver's own format says of it, and the truth at its reception.

    The directions are per row of the epoch.
    """

    epoch: Epoch
    clock_reset: bool
    half_cycle_subtracted: NDArray[np.bool_]
    true_time: GpsTime
    position_ecef_m: NDArray[np.float64]
    velocity_ecef_mps: NDArray[np.float64]
    azimuth_rad: NDArray[np.float64]
    elevation_rad: NDArray[np.float64]


def _signal_table() -> tuple[NDArray[np.int16], NDArray[np.float64]]:
    """Return signal numbers (-1: none) and carriers (Hz) of all satellites and slots."""
    signals, carriers = np.full((len(SATELLITES), SLOTS), -1, np.int16), np.ones((len(SATELLITES), SLOTS))
    for i, satellite in enumerate(SATELLITES.tolist()):
        system, number = divmod(satellite, SATELLITES_PER_SYSTEM)
        for j, code in enumerate(_SIGNALS[system]):
            if j == 0 or system != GPS or number not in _WITHOUT_L2C:
                signals[i, j] = signal_number(code)
                carriers[i, j] = carrier_hz(satellite, int(signals[i, j]), int(CHANNELS[i]))
    return signals, carriers


_SIGNAL_OF, _CARRIER_HZ = _signal_table()


def _signals_of(options: ReceiverOptions) -> NDArray[np.int16]:
    """Return the signal numbers of what a receiver tracks, -1 elsewhere."""
    signals = _SIGNAL_OF.copy()
    signals[[SYSTEMS[s // SATELLITES_PER_SYSTEM] not in options.systems for s in SATELLITES.tolist()]] = -1
    signals[:, options.frequencies :] = -1
    return signals


def _epoch_of(tag: GpsTime, measured: Measured, count: int) -> tuple[Epoch, NDArray[np.int64]]:
    """Return the epoch of so many measurements, and the places of their satellites in SATELLITES."""
    place, values = measured.place[:count], measured.values[:, :count]
    satellite = place // SLOTS
    epoch = Epoch(
        tag, SATELLITES[satellite], _SIGNAL_OF.ravel()[place], CHANNELS[satellite], measured.flags[:count], values[PSEUDORANGE],
        values[PHASE], values[DOPPLER], values[CN0], values[LOCK], values[CODE_SIGMA], values[PHASE_SIGMA],
    )  # fmt: skip
    return epoch, satellite


class ReceiverClock:
    """Offset of a receiver's clock as a closed form of time: drift, a slow wander and jumps of a millisecond, or held near zero."""

    def __init__(self, drift: float, *, steered: bool, rng: np.random.Generator, jumps_at_s: float | None = None) -> None:
        self._drift = 0.0 if steered else drift
        self._start_s = 0.0 if steered else float(rng.uniform(-0.4e-3, 0.4e-3))
        self._phase = float(rng.uniform(0.0, 2.0 * pi))
        if jumps_at_s is not None and not steered:
            wander_s = _WANDER_S * sin(2.0 * pi * jumps_at_s / _WANDER_PERIOD_S + self._phase)
            self._start_s = 0.5 * _MILLISECOND_S - drift * jumps_at_s - wander_s

    def offset(self, time_s: float) -> tuple[float, float, int]:
        """Return reading minus GPS time (s), its rate (s/s), and how many jumps there were before."""
        angle = 2.0 * pi * time_s / _WANDER_PERIOD_S + self._phase
        raw_s = self._start_s + self._drift * time_s + _WANDER_S * sin(angle)
        jumps = floor(raw_s / _MILLISECOND_S + 0.5)
        return raw_s - jumps * _MILLISECOND_S, self._drift + _WANDER_S * 2.0 * pi / _WANDER_PERIOD_S * cos(angle), jumps


class Receiver:
    """Observes the sky from one antenna; epochs must be asked for in rising order.

    ``name`` and ``seed`` decide every random number of an epoch together with its time. ``surroundings``: what stands around the
    antenna (None: nothing); ``activity`` and ``slope_ppm``: what the ionosphere has beyond its model (see ``Atmosphere``); ``clock``: that
    of another antenna of the same receiver.
    """

    def __init__(
        self, name: str, path: AntennaPath, seed: int, options: ReceiverOptions, windows: tuple[Window, ...] = (),
        surroundings: Surroundings | None = None, activity: float = 1.0, clock: ReceiverClock | None = None, *, slope_ppm: float = 0.0,
    ) -> None:  # fmt: skip
        self._key = (seed, int.from_bytes(name.encode(), "big"))
        self._path, self._options, self._windows, self._surroundings = path, options, windows, surroundings
        self._sky, self._atmosphere = Sky(), Atmosphere(seed, activity, slope_ppm)
        rng = np.random.default_rng((*self._key, 1))
        self.clock = clock or ReceiverClock(options.clock_drift, steered=options.steered, rng=rng, jumps_at_s=options.jumps_at_s)
        code_biases_m = rng.normal(0.0, 1.0, (MAX_SATELLITE // SATELLITES_PER_SYSTEM, SLOTS))
        phase_biases_cyc = rng.uniform(0.0, 1.0, code_biases_m.shape)
        n = len(SATELLITES)
        lasting, self._track = rng.standard_normal((n, SLOTS, 3)), np.full((n, SLOTS, TRACK), np.nan)
        self._tracked = Tracked(self._track, _signals_of(options), _CARRIER_HZ, CHANNELS, code_biases_m, phase_biases_cyc, lasting)
        self._travel_s = np.full(n, _TRAVEL_S)
        self._view = np.zeros((n, VIEW))
        self._states, self._geometry, self._rates = np.empty((n, STATE)), np.empty((n, GEOMETRY)), np.empty(n)
        self._klobuchar = klobuchar_vector(KLOBUCHAR)
        self._last: GpsTime | None = None
        self._jumps = 0

    def observe(self, tag: GpsTime) -> Observed:
        """Return what is measured when the receiver's clock reads ``tag``."""
        tag_s = absolute_s(tag)
        clock_s, clock_rate, jumps = self.clock.offset(tag_s)
        time = tag + -clock_s
        time_s = tag_s - clock_s
        rows = self._sky.rows(time)
        offset = self._path.offset_enu_m(time_s)
        position, velocity = self._path.ecef_of(offset), self._path.velocity_ecef_mps(time_s)
        signal_paths(
            rows, time.week, time.tow_s, position, velocity, self._klobuchar, self._travel_s, self._states, self._geometry, self._rates
        )
        self._add_weather(offset, time_s)
        rng = np.random.default_rng((*self._key, round(tag.week * 604800000 + tag.tow_s * 1e3)))
        shape = (len(SATELLITES), SLOTS)
        normals, uniforms = rng.standard_normal((*shape, NORMALS)), rng.random((*shape, UNIFORMS))
        if self._surroundings is not None:
            azimuth, elevation = (np.ascontiguousarray(self._geometry[:, column]) for column in (AZIMUTH, ELEVATION))
            self._surroundings(offset, self._path.velocity_enu_mps(time_s), azimuth, elevation, self._view)
        self._step_tracking(tag, tag_s, normals, uniforms, rng.random(shape))
        reset, self._jumps = self._last is not None and jumps != self._jumps, jumps
        self._last = tag
        arriving = Arriving(rows, self._states, self._geometry, self._rates, self._view)
        measured = room_to_measure(len(SATELLITES))
        count = measure(arriving, self._tracked, (tag_s, clock_s, clock_rate), self._options.signals, normals, measured)
        epoch, satellite = _epoch_of(tag, measured, count)
        azimuth, elevation = self._geometry[satellite, AZIMUTH], self._geometry[satellite, ELEVATION]
        return Observed(epoch, reset, measured.halves[:count], time, position, velocity, azimuth, elevation)

    def _add_weather(self, offset_enu_m: NDArray[np.float64], time_s: float) -> None:
        """Add what the atmosphere has beyond the models."""
        geometry, atmosphere = self._geometry, self._atmosphere
        elevation = geometry[:, ELEVATION]
        wet_m = atmosphere.zenith_wet_m(offset_enu_m, time_s)
        geometry[:, TROPOSPHERE_M] += wet_m * 1.001 / np.sqrt(0.002001 + np.sin(elevation) ** 2)  # RTCA DO-229D A.4.2.4
        geometry[:, IONOSPHERE_L1_M] += atmosphere.ionosphere_l1_m(offset_enu_m, time_s, geometry[:, AZIMUTH], elevation)

    def _step_tracking(
        self, tag: GpsTime, tag_s: float, normals: NDArray[np.float64], uniforms: NDArray[np.float64], notices: NDArray[np.float64]
    ) -> None:
        first = self._last is None
        step_s = 0.0 if self._last is None else tag - self._last
        if self._last is not None and glonass_generation(self._last) != glonass_generation(tag):
            self._track[SATELLITES // SATELLITES_PER_SYSTEM == GLONASS] = np.nan
        lowest_rad = max(self._options.elevation_mask_rad, hidden_below_rad(self._windows, tag_s))
        update_tracking(
            self._track, self._geometry, self._view, tag_s, step_s, lowest_rad, first and self._options.warm, self._options.signals,
            normals, uniforms, notices,
        )  # fmt: skip
