"""The scenarios by name, and what the outside asks of them: the byte stream of an antenna and the truth.

Everything but the receivers' own luck is a function of scenario, seed and absolute time, so processes that simulate different
antennas, or one that is started again, agree on sky, atmosphere and motion.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from math import ceil, pi, radians
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.errors import OptionError
from rtkmesh.gnss.constants import SECONDS_PER_WEEK
from rtkmesh.gnss.time import GpsTime
from rtkmesh.simulation.classes import F9P, SURVEY, moving
from rtkmesh.simulation.environment import Window
from rtkmesh.simulation.receiver import Receiver, ReceiverClock, ReceiverOptions
from rtkmesh.simulation.rtcm3_stream import Rtcm3Stream
from rtkmesh.simulation.sky import absolute_s
from rtkmesh.simulation.trajectories import AntennaPath, Site, Trajectory, boat, driving, static
from rtkmesh.simulation.ubx_stream import UbxStream
from rtkmesh.simulation.unicore_stream import UnicoreStream

Vector = NDArray[np.float64]
Offset = tuple[float, float, float]

MAX_RATE_HZ: Final = 50.0
_LONGEST_DELAY_S: Final = 300.0

_BASE: Final = replace(SURVEY, signals=SURVEY.signals._replace(glonass_slopes_m=(0.02, 0.018)), steered=True)
_ROVER: Final = F9P
_HEADING: Final = replace(F9P, clock_drift=-1.7e-7)
_MOVING: Final = moving(F9P.signals, 10.0)._replace(slips_per_hour=2.0)


@dataclass(frozen=True, slots=True)
class Antenna:
    """An antenna and its receiver: on the vehicle (``offset_m`` forward, right, down in the body) or, as base, at a place in ENU."""

    offset_m: Offset
    options: ReceiverOptions = _ROVER
    fixed: bool = False


@dataclass(frozen=True, slots=True)
class Scenario:
    """A site, a vehicle, its antennas and a base station; ``windows`` hide the vehicle's sky."""

    site: Site
    trajectory: Trajectory
    antennas: dict[str, Antenna]
    windows: tuple[Window, ...] = field(default=())


_SITE: Final = Site(radians(52.5), radians(13.4), 80.0)
_BASE_ANTENNA: Final = Antenna((-420.0, 260.0, 12.0), _BASE, fixed=True)
_ON_THE_ROAD: Final = ReceiverOptions(signals=_MOVING, clock_drift=3.1e-7), ReceiverOptions(signals=_MOVING, clock_drift=-1.7e-7)
_TWO_ANTENNAS: Final = {"rover": Antenna((-0.3, 0.0, -1.5), _ON_THE_ROAD[0]), "heading": Antenna((0.7, 0.0, -1.5), _ON_THE_ROAD[1])}
_ALL_OF_IT: Final = pi

SCENARIOS: Final = {
    "demo": Scenario(_SITE, driving, {**_TWO_ANTENNAS, "base": _BASE_ANTENNA}),
    "static": Scenario(
        _SITE, static, {"rover": Antenna((0.0, 0.0, -1.0), _ROVER), "heading": Antenna((1.0, 0.0, -1.0), _HEADING), "base": _BASE_ANTENNA}
    ),
    "boat": Scenario(
        _SITE,
        boat,
        {
            "rover": Antenna((-1.0, -0.6, -2.0), _ON_THE_ROAD[0]),
            "heading": Antenna((1.0, -0.6, -2.0), _ON_THE_ROAD[1]),
            "starboard": Antenna((-1.0, 0.6, -2.0), _ON_THE_ROAD[0]),
            "bow": Antenna((1.0, 0.6, -2.0), _ON_THE_ROAD[1]),
            "base": _BASE_ANTENNA,
        },
    ),
    "two_bases": Scenario(
        _SITE, driving, {**_TWO_ANTENNAS, "base": _BASE_ANTENNA, "base2": Antenna((2300.0, -1500.0, 30.0), _BASE, fixed=True)}
    ),
    "dive": Scenario(
        _SITE,
        driving,
        {**_TWO_ANTENNAS, "base": _BASE_ANTENNA},
        (Window(120.0, 60.0, 15.0, _ALL_OF_IT), Window(120.0, 30.0, 8.0, radians(35.0)), Window(45.0, 20.0, 1.2, _ALL_OF_IT)),
    ),
    # Under water for 8 of every 30 s: a short mission of an AUV, which tells its depth itself.
    "auv": Scenario(_SITE, boat, {**_TWO_ANTENNAS, "base": _BASE_ANTENNA}, (Window(30.0, 15.0, 8.0, _ALL_OF_IT),)),
}


@dataclass(frozen=True, slots=True)
class SimulatedEpoch:
    """All bytes that a receiver sends for one epoch, and the true GPS time at which it was received."""

    time: GpsTime
    data: bytes


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """Where everything truly is at a time: positions and velocities of the antennas by name, and the vehicle's attitude."""

    time: GpsTime
    antennas_ecef_m: dict[str, Vector]
    velocities_ecef_mps: dict[str, Vector]
    heading_rad: float
    pitch_rad: float
    roll_rad: float


class SimulatedStream:
    """The endless stream of one receiver; every call of ``epochs`` begins anew at the start."""

    def __init__(self, scenario: str, stream: str, *, seed: int, rate_hz: float, start: GpsTime, warm: bool = True) -> None:
        self._scenario, self._names = _scenario(scenario), tuple(stream.split("+", 1))
        self._antennas = [_find(scenario, name) for name in self._names]
        if not 0.0 < rate_hz <= MAX_RATE_HZ or abs(1e3 / rate_hz - round(1e3 / rate_hz)) > 1e-6:
            raise OptionError(f"rate {rate_hz} Hz is not one epoch every whole number of milliseconds, at most {MAX_RATE_HZ} Hz")
        if seed < 0:
            raise OptionError(f"seed {seed} is negative")
        self._seed, self._start, self._warm = seed, start, warm
        self._step_ms = round(1e3 / rate_hz)

    def receiver(self) -> Receiver:
        """Return a fresh receiver of this (first) antenna: observations without their encoding, for tests."""
        return self._receiver(0)

    def _receiver(self, number: int, clock: ReceiverClock | None = None) -> Receiver:
        antenna = self._antennas[number]
        windows = () if antenna.fixed else self._scenario.windows
        options = replace(antenna.options, warm=self._warm, steered=antenna.options.steered or len(self._names) > 1)
        path = _path(self._scenario, antenna, self._seed)
        return Receiver(self._names[number], path, self._seed, options, windows, clock=clock)

    def tags(self) -> Iterator[GpsTime]:
        """Yield the nominal times of all epochs: multiples of the interval in GPS time, from the start on."""
        first_ms = ceil((self._start.tow_s * 1e3) / self._step_ms - 1e-6) * self._step_ms
        week = self._start.week
        while True:
            if first_ms >= SECONDS_PER_WEEK * 1e3:
                week, first_ms = week + 1, first_ms - round(SECONDS_PER_WEEK * 1e3)
            yield GpsTime(week, first_ms * 1e-3)
            first_ms += self._step_ms

    def epochs(self) -> Iterator[SimulatedEpoch]:
        """Yield all epochs in order, for ever; the caller paces."""
        first, encode = self._receiver(0), self._encoder()
        receivers = [first, *(self._receiver(number, first.clock) for number in range(1, len(self._names)))]
        for tag in self.tags():
            observed = [receiver.observe(tag) for receiver in receivers]
            yield SimulatedEpoch(observed[0].true_time, encode(*observed))

    def _encoder(self) -> Callable[..., bytes]:
        if len(self._names) > 1:
            return UnicoreStream(self._seed, warm=self._warm).encode
        if not self._antennas[0].fixed:
            return UbxStream(self._seed, warm=self._warm).encode
        x, y, z = _path(self._scenario, self._antennas[0], self._seed).position_ecef_m(0.0).tolist()
        return Rtcm3Stream((x, y, z), warm=self._warm).encode


def open_stream(scenario: str, stream: str, *, seed: int, rate_hz: float, start: GpsTime, warm: bool = True) -> SimulatedStream:
    """Return the stream of an antenna of a scenario; OptionError for names that do not exist.

    UBX for antennas of the vehicle, RTCM 3 for the base; two names with a ``+`` are one receiver with two antennas, which speaks as a
    Unicore UM982 does. ``warm``: the receiver tracks everything already and hands out all
    ephemerides within two seconds; else it acquires satellites one by one and ephemerides take up to 30 s.
    """
    return SimulatedStream(scenario, stream, seed=seed, rate_hz=rate_hz, start=start, warm=warm)


def truth(scenario: str, *, seed: int) -> Callable[[GpsTime], Truth]:
    """Return the function that tells the truth of a scenario at any (true) time."""
    chosen = _scenario(scenario)
    trajectory = _delayed(chosen.trajectory, seed)
    paths = {name: _path(chosen, antenna, seed) for name, antenna in chosen.antennas.items()}

    def at(time: GpsTime) -> Truth:
        time_s = absolute_s(time)
        pose = trajectory(time_s)
        return Truth(
            time,
            {name: path.position_ecef_m(time_s) for name, path in paths.items()},
            {name: path.velocity_ecef_mps(time_s) for name, path in paths.items()},
            pose.heading_rad,
            pose.pitch_rad,
            pose.roll_rad,
        )

    return at


def _scenario(name: str) -> Scenario:
    if name not in SCENARIOS:
        raise OptionError(f"no scenario {name!r}; there are {', '.join(sorted(SCENARIOS))}")
    return SCENARIOS[name]


def _find(scenario: str, stream: str) -> Antenna:
    chosen = _scenario(scenario)
    if stream not in chosen.antennas:
        raise OptionError(f"scenario {scenario!r} has no stream {stream!r}; there are {', '.join(chosen.antennas)}")
    return chosen.antennas[stream]


def _delayed(trajectory: Trajectory, seed: int) -> Trajectory:
    """Return the motion begun at another moment for every seed."""
    delay_s = float(np.random.default_rng((seed, 9001)).uniform(0.0, _LONGEST_DELAY_S))
    return lambda time_s: trajectory(time_s - delay_s)


def _path(scenario: Scenario, antenna: Antenna, seed: int) -> AntennaPath:
    return AntennaPath(scenario.site, None if antenna.fixed else _delayed(scenario.trajectory, seed), antenna.offset_m)
