"""A synthetic sky for the tests of the models: closed-form ephemerides and the epochs that they would give."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from math import pi

import numpy as np
import pytest
from numpy.typing import NDArray

from rtkmesh.gnss.constants import SPEED_OF_LIGHT_MPS
from rtkmesh.gnss.ephemeris import Ephemeris, GlonassEphemeris, KeplerEphemeris, NavigationMessage
from rtkmesh.gnss.epoch import Epoch, make_epoch
from rtkmesh.gnss.frames import ecef_from_geodetic
from rtkmesh.gnss.signals import SYSTEMS, carrier_hz, satellite_number, signal_number
from rtkmesh.gnss.time import GpsTime
from rtkmesh.models.atmosphere import klobuchar_vector
from rtkmesh.models.ephemeris_table import EphemerisTable
from rtkmesh.models.geometry import ELEVATION, GEOMETRY, IONOSPHERE_L1_M, RANGE, TROPOSPHERE_M, receiver_model
from rtkmesh.models.orbit import STATE, STATE_CLOCK, STATE_OK, group_delay_m

NOON = GpsTime(2150, 396000.0)
PLACE_ECEF_M = ecef_from_geodetic(0.6, 2.4, 75.0)
SIGNAL = {"G": "1C", "R": "1C", "E": "1C", "C": "2I", "J": "1C"}
_MESSAGE = {"G": NavigationMessage.LNAV, "E": NavigationMessage.INAV, "C": NavigationMessage.D1, "J": NavigationMessage.LNAV}


def kepler(name: str, toe: GpsTime = NOON, **changes: object) -> KeplerEphemeris:
    """Return a plausible ephemeris: planes and phases spread by the satellite's number."""
    number = int(name[1:])
    values: dict[str, object] = {
        "satellite": satellite_number(name), "message": _MESSAGE[name[0]], "iode": 1, "iodc": 1, "toe": toe, "toc": toe,
        "transmitted": toe + -3600.0, "health": 0, "accuracy_m": 2.0, "fit_s": 7200.0,
        "sqrt_a": {"G": 5153.6, "E": 5440.6, "C": 5282.6, "J": 6493.4}[name[0]], "eccentricity": 0.001 * (number % 12),
        "m0_rad": (number * 2.399963) % (2.0 * pi) - pi, "delta_n_radps": 4.3e-9, "omega0_rad": (number % 6) * pi / 3.0 - pi,
        "omega_rad": 0.7, "omega_dot_radps": -8.0e-9, "i0_rad": 0.96, "idot_radps": 2.0e-10, "cuc_rad": 3.5e-6, "cus_rad": 4.4e-6,
        "crc_m": 304.5, "crs_m": 65.0, "cic_rad": -1.3e-7, "cis_rad": 4.2e-7, "af0_s": 1e-5 * (number - 10), "af1": -5.6e-12, "af2": 0.0,
        "group_delay_s": (1.0e-9 * (number % 7), -2.0e-9),
    }  # fmt: skip
    return KeplerEphemeris(**{**values, **changes})


def glonass(name: str, toe: GpsTime = NOON, **changes: object) -> GlonassEphemeris:
    """Return a state on a circle of 25 508 km, inclined by 64.8 degrees, in the rotating frame."""
    number = int(name[1:])
    node, phase, radius = (number % 3) * 2.0 * pi / 3.0, number * 2.0 * pi / 8.0 + 0.2 * (number % 3), 25.508e6
    speed, tilt, earth = 3953.0, np.deg2rad(64.8), 7.292115e-5
    a, b = np.array([np.cos(node), np.sin(node), 0.0]), np.array([-np.sin(node) * np.cos(tilt), np.cos(node) * np.cos(tilt), np.sin(tilt)])
    position = radius * (np.cos(phase) * a + np.sin(phase) * b)
    velocity = speed * (-np.sin(phase) * a + np.cos(phase) * b) - np.cross([0.0, 0.0, earth], position)
    values: dict[str, object] = {
        "satellite": satellite_number(name), "channel": number % 13 - 7, "iode": 1, "toe": toe, "transmitted": toe, "health": 0,
        "accuracy_m": 5.0, "age_days": 0, "position_m": tuple(position), "velocity_mps": tuple(velocity),
        "acceleration_mps2": (1e-6, -1e-6, 2e-6), "tau_s": -3e-5, "gamma": 1e-12, "group_delay_s": 2e-9,
    }  # fmt: skip
    return GlonassEphemeris(**{**values, **changes})


def whole_sky(toe: GpsTime = NOON) -> list[Ephemeris]:
    sky: list[Ephemeris] = [
        kepler(f"{letter}{number:02d}", toe) for letter, many in (("G", 31), ("E", 27), ("C", 30)) for number in range(6, many)
    ]
    return sky + [glonass(f"R{number:02d}", toe) for number in range(1, 25)]


@dataclass
class Sky:
    """Makes the epochs that a receiver would measure; ``noise_m`` and faults are added by the tests."""

    table: EphemerisTable = field(default_factory=EphemerisTable)
    satellites: NDArray[np.int16] = field(default_factory=lambda: np.zeros(0, np.int16))
    atmosphere: float = 1.0

    def add(self, ephemerides: Iterable[Ephemeris]) -> "Sky":
        for ephemeris in ephemerides:
            assert self.table.add(ephemeris)
            self.satellites = np.append(self.satellites, np.int16(ephemeris.satellite))
        return self

    def pseudoranges(self, tag: GpsTime, position_ecef_m: NDArray[np.float64], clock_m: dict[str, float]) -> NDArray[np.float64]:
        """Return the codes (m) of SIGNAL at a receiver's tag, by iteration on the flight time; NaN below 10 degrees."""
        rows, count = self.table.select(self.satellites, tag), len(self.satellites)
        letters = [SYSTEMS[s // 64] for s in self.satellites]
        states, geometry = np.empty((count, STATE)), np.empty((count, GEOMETRY))
        offset = np.array([clock_m[letter] for letter in letters])
        delay = np.array([group_delay_m(rows[i], signal_number(SIGNAL[letter])) for i, letter in enumerate(letters)])
        l1 = np.array([self._ratio(i, letter) for i, letter in enumerate(letters)])
        codes = np.full(count, 2.3e7)
        for _ in range(6):
            receiver_model(rows, tag.week, tag.tow_s, codes, position_ecef_m, klobuchar_vector(None), states, geometry)
            assert states[:, STATE_OK].all()
            air = geometry[:, TROPOSPHERE_M] + l1 * geometry[:, IONOSPHERE_L1_M]
            codes = geometry[:, RANGE] - SPEED_OF_LIGHT_MPS * states[:, STATE_CLOCK] + delay + offset + self.atmosphere * air
        return np.where(geometry[:, ELEVATION] > np.deg2rad(10.0), codes, np.nan)

    def _ratio(self, i: int, letter: str) -> float:
        channel = self.table.channel(int(self.satellites[i]))
        return (1575.42e6 / carrier_hz(int(self.satellites[i]), signal_number(SIGNAL[letter]), channel)) ** 2

    def epoch(self, tag: GpsTime, position_ecef_m: NDArray[np.float64], clock_m: dict[str, float] | float = 0.0) -> Epoch:
        clocks = clock_m if isinstance(clock_m, dict) else dict.fromkeys(SYSTEMS, clock_m)
        codes = self.pseudoranges(tag, position_ecef_m, clocks)
        up = np.isfinite(codes)
        satellites = self.satellites[up]
        signals = np.array([signal_number(SIGNAL[SYSTEMS[s // 64]]) for s in satellites])
        channels = self.table.channels(satellites)
        return make_epoch(tag, satellite=satellites, signal=signals, pseudorange_m=codes[up], channel=channels)


@pytest.fixture
def sky() -> Sky:
    """All systems, 24 to 27 satellites each."""
    return Sky().add(whole_sky())


@pytest.fixture
def make_sky() -> Callable[[GpsTime], Sky]:
    return lambda toe: Sky().add(whole_sky(toe))


@pytest.fixture
def make_kepler() -> Callable[..., KeplerEphemeris]:
    return kepler


@pytest.fixture
def make_glonass() -> Callable[..., GlonassEphemeris]:
    return glonass


@pytest.fixture
def place_ecef_m() -> NDArray[np.float64]:
    return PLACE_ECEF_M.copy()


@pytest.fixture
def noon() -> GpsTime:
    return NOON
