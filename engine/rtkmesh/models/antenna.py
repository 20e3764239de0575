"""Phase centres of receiver antennas: calibrations packed for kernels, and the delay that they make.

A receiver measures from the phase centre of its antenna, which is another one for each carrier and each direction; positions are of the
antenna reference point (ARP). ANTEX 1.4: observed = geometric - offset . direction + variation.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from math import cos, floor, radians, sin
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place
from rtkmesh.gnss.antenna import NO_RADOME, AntennaCalibration, BandCalibration, Calibrations, antenna_name
from rtkmesh.gnss.signals import SYSTEMS

Vector = NDArray[np.float64]

NULL_ANTENNA: Final = "NULLANTENNA"  # ADVNULLANTENNA, GPPNULLANTENNA: a network has already reduced the observations to the ARP
_BANDS: Final = 10
# Carriers (RINEX bands) by what stands in for them: upper L band for 1559 to 1610 MHz, lower for 1164 to 1300 MHz.
_UPPER: Final = {"G": "1", "R": "14", "E": "1", "C": "12", "J": "1", "S": "1", "I": "1"}
_LOWER: Final = {"G": "25", "R": "236", "E": "5678", "C": "5678", "J": "256", "S": "5", "I": "5"}
# Systems that share a carrier frequency, by band: an offset of one is that of the other.
_SHARED: Final = {"1": "GEJCSI", "5": "GEJCSI", "6": "EJ", "7": "EC", "8": "EC"}


# A pattern is one vector, because kernels take every array of their arguments at a price: the shape of the grid and its steps (rad); the
# place of each carrier (systems x RINEX bands), negative where it has no calibration; at its place a carrier has its offset (m; east,
# north, up) and its variation (m; azimuths x zenith angles). Azimuths go from 0 to 2 pi, both included; one: azimuth does not matter.
_AZIMUTHS, _ZENITHS, _AZIMUTH_STEP, _ZENITH_STEP, _PLACES = range(5)
_OFFSET: Final = 3

NO_PATTERNS: Final = np.zeros(0)  # of two receivers whose antennas are not both known


@dataclass(frozen=True, slots=True, eq=False)
class Antenna:
    """A receiver's antenna as the engine takes it.

    ``name`` is that of the calibration; ``radome`` the one that was asked for where it has none and that without radome stands in;
    ``substitutes`` says which carriers have no calibration of their own and whose is taken, by ANTEX codes (``{"E01": "G01"}``).
    """

    name: str
    pattern: Vector
    substitutes: dict[str, str] = field(default_factory=dict[str, str])
    radome: str = ""

    def __str__(self) -> str:
        said = [f"radome {self.radome} not calibrated"] if self.radome else []
        if self.substitutes:
            said.append(f"other carriers as {' '.join(sorted(set(self.substitutes.values())))}")
        return f"{self.name} ({'; '.join(said)})" if said else self.name


def antenna_of(calibration: AntennaCalibration) -> Antenna:
    """Return the antenna of a calibration.

    A carrier without calibration takes the one of its frequency in another system, else that of GPS: L1 for the upper L band, L2 for the
    lower one (IGS practice), L1 also there if that is all there is. Carriers outside both bands get no correction.
    """
    azimuths, zeniths = calibration.bands[0].variation_m.shape
    begin, size = _PLACES + len(SYSTEMS) * _BANDS, _OFFSET + azimuths * zeniths
    places = {band.frequency: begin + k * size for k, band in enumerate(calibration.bands)}
    table, substitutes = np.full((len(SYSTEMS), _BANDS), -1.0), dict[str, str]()
    for code, candidates in _carriers():
        found = next((name for name in candidates if name in places), None)
        if found is None:
            continue
        table[SYSTEMS.index(code[0]), int(code[2])] = places[found]
        if found != code:
            substitutes[code] = found
    steps_rad = radians(calibration.azimuth_step_deg), radians(calibration.zenith_step_deg)
    bands = [np.concatenate((band.offset_enu_m, band.variation_m.ravel())) for band in calibration.bands]
    pattern = np.concatenate(((azimuths, zeniths, *steps_rad), table.ravel(), *bands))
    serial = f" {calibration.serial}" if calibration.serial else ""
    return Antenna(f"{calibration.antenna} {calibration.radome}{serial}", pattern, substitutes)


def _carriers() -> Iterator[tuple[str, list[str]]]:
    """Yield the ANTEX code of each carrier with those that may stand for it, best first."""
    for bands, last in ((_UPPER, ["G01"]), (_LOWER, ["G02", "G01"])):
        for system, numbers in bands.items():
            for band in numbers:
                shared = _SHARED.get(band, "")
                own = [f"{system}0{band}", *(f"{other}0{band}" for other in shared if system in shared)]
                glonass = [f"R0{1 if bands is _UPPER else 2}"] if system == "R" else []
                yield own[0], own + glonass + last


def join_patterns(rover: Antenna, base: Antenna) -> Vector:
    """Return the patterns of both receivers in one vector for kernels: the length of the rover's, the rover's, the base's."""
    return np.concatenate(((float(len(rover.pattern)),), rover.pattern, base.pattern))


@kernel
def pattern_of(patterns: Vector, receiver: int) -> Vector:
    """Return the pattern of one receiver (0: rover, 1: base) of ``join_patterns``."""
    end = 1 + int(patterns[0])
    return patterns[1:end] if receiver == 0 else patterns[end:]


def null_antenna(name: str) -> Antenna:
    """Return an antenna whose phase centres all are at its reference point."""
    flat = BandCalibration("G01", (0.0, 0.0, 0.0), np.zeros((1, 2)))
    antenna = antenna_of(AntennaCalibration(name, NO_RADOME, "", 90.0, 0.0, (flat,)))
    return Antenna(name, antenna.pattern)


def find_antenna(tables: Iterable[Calibrations], name: str, serial: str = "") -> Antenna | str:
    """Return the antenna of an IGS name from the first table that has it, or why there is none.

    A radome that no table has is taken as NONE, which is IGS practice. FormatError if the calibration is damaged.
    """
    tables = tuple(tables)
    antenna, radome = antenna_name(name)
    if antenna.endswith(NULL_ANTENNA):
        return null_antenna(antenna)
    for taken in dict.fromkeys((radome, NO_RADOME)):
        for table in tables:
            if (calibration := table.find(antenna, taken, serial)) is not None:
                found = antenna_of(calibration)
                return found if taken == radome else replace(found, radome=radome)
    return f"no calibration of {antenna} {radome}"


@kernel_in_place
def carrier_place(pattern: Vector, system: int, band: int) -> int:
    """Return where a pattern has the carrier of a system (GPS, ...) and RINEX band; negative if it has no calibration for it."""
    return int(pattern[_PLACES + system * _BANDS + band])


@kernel_in_place
def antenna_correction_m(pattern: Vector, place: int, azimuth_rad: float, elevation_rad: float) -> float:
    """Return the delay (m) that an antenna adds to a range: subtract it from what was observed, code or phase.

    ``place`` is of ``carrier_place``; azimuth clockwise from north, the direction of the satellite in the receiver's east, north, up,
    which is the antenna's frame: level, north mark to the north. Bilinear in azimuth and zenith angle; beyond the last zenith angle of
    the calibration its last value. 0 for a negative place. ANTEX 1.4, "Phase center corrections".
    """
    if place < 0:
        return 0.0
    flat, high = cos(elevation_rad), sin(elevation_rad)
    east, north = flat * sin(azimuth_rad), flat * cos(azimuth_rad)
    along = pattern[place] * east + pattern[place + 1] * north + pattern[place + 2] * high
    azimuths, zeniths = int(pattern[_AZIMUTHS]), int(pattern[_ZENITHS])
    z = min(max((0.5 * np.pi - elevation_rad) / pattern[_ZENITH_STEP], 0.0), zeniths - 1.0)
    j = min(int(z), zeniths - 2)
    near = place + _OFFSET + j
    if azimuths == 1:
        return pattern[near] + (pattern[near + 1] - pattern[near]) * (z - j) - along
    a = azimuth_rad / pattern[_AZIMUTH_STEP]
    a = a - (azimuths - 1) * floor(a / (azimuths - 1))
    i = min(int(a), azimuths - 2)
    near += i * zeniths
    far = near + zeniths
    first = pattern[near] + (pattern[near + 1] - pattern[near]) * (z - j)
    second = pattern[far] + (pattern[far + 1] - pattern[far]) * (z - j)
    return first + (second - first) * (a - i) - along
