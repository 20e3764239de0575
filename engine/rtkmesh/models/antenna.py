"""Phase centres of receiver antennas: calibrations packed for kernels, and the delay that they make.

A receiver measures from the phase centre of its antenna, which is another one for each carrier and each direction; positions are of the
antenna reference point (ARP). ANTEX 1.4: observed = geometric - offset . direction + variation.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from math import cos, floor, pi, radians, sin
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.gnss.antenna import NO_RADOME, AntennaCalibration, BandCalibration, Calibrations, antenna_name
from rtkmesh.gnss.signals import SYSTEMS

Matrix = NDArray[np.float64]

NULL_ANTENNA: Final = "NULLANTENNA"  # ADVNULLANTENNA, GPPNULLANTENNA: a network has already reduced the observations to the ARP
_BANDS: Final = 10
_NOT_CALIBRATED: Final = -1
# Carriers (RINEX bands) by what stands in for them: upper L band for 1559 to 1610 MHz, lower for 1164 to 1300 MHz.
_UPPER: Final = {"G": "1", "R": "14", "E": "1", "C": "12", "J": "1", "S": "1", "I": "1"}
_LOWER: Final = {"G": "25", "R": "236", "E": "5678", "C": "5678", "J": "256", "S": "5", "I": "5"}
# Systems that share a carrier frequency, by band: an offset of one is that of the other.
_SHARED: Final = {"1": "GEJCSI", "5": "GEJCSI", "6": "EJ", "7": "EC", "8": "EC"}


class Pattern(NamedTuple):
    """What kernels take of an antenna; of one that is not known, ``known`` is False and the rest empty.

    ``row`` (systems, RINEX bands) is the row of a signal's band in ``offset_enu_m`` (n, 3) and ``variation_m`` (n, azimuths, zenith
    angles), negative where there is no calibration. Azimuths go from 0 to 2 pi, both included; one column of them: azimuth does not matter.
    """

    known: bool
    row: NDArray[np.int8]
    offset_enu_m: Matrix
    variation_m: NDArray[np.float64]
    azimuth_step_rad: float
    zenith_step_rad: float


NO_PATTERN: Final = Pattern(
    False, np.full((len(SYSTEMS), _BANDS), _NOT_CALIBRATED, np.int8), np.zeros((1, 3)), np.zeros((1, 1, 2)), 2.0 * pi, pi / 2
)


class Patterns(NamedTuple):
    """The antennas of rover and base."""

    rover: Pattern
    base: Pattern


NO_PATTERNS: Final = Patterns(NO_PATTERN, NO_PATTERN)


@dataclass(frozen=True, slots=True, eq=False)
class Antenna:
    """A receiver's antenna as the engine takes it.

    ``name`` is that of the calibration; ``radome`` the one that was asked for where it has none and that without radome stands in;
    ``substitutes`` says which carriers have no calibration of their own and whose is taken, by ANTEX codes (``{"E01": "G01"}``).
    """

    name: str
    pattern: Pattern
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
    rows = {band.frequency: row for row, band in enumerate(calibration.bands)}
    table, substitutes = np.full((len(SYSTEMS), _BANDS), _NOT_CALIBRATED, np.int8), dict[str, str]()
    for code, candidates in _carriers():
        found = next((name for name in candidates if name in rows), None)
        if found is None:
            continue
        table[SYSTEMS.index(code[0]), int(code[2])] = rows[found]
        if found != code:
            substitutes[code] = found
    offset_m = np.array([band.offset_enu_m for band in calibration.bands])
    variation_m = np.ascontiguousarray([band.variation_m for band in calibration.bands])
    azimuth_step_rad = radians(calibration.azimuth_step_deg) or 2.0 * pi
    pattern = Pattern(True, table, offset_m, variation_m, azimuth_step_rad, radians(calibration.zenith_step_deg))
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


@kernel
def antenna_correction_m(pattern: Pattern, row: int, azimuth_rad: float, elevation_rad: float) -> float:
    """Return the delay (m) that an antenna adds to a range: subtract it from what was observed, code or phase.

    ``row`` is of ``pattern.row``; azimuth clockwise from north, the direction of the satellite in the receiver's east, north, up, which
    is the antenna's frame: level, north mark to the north. Bilinear in azimuth and zenith angle; beyond the last zenith angle of the
    calibration its last value. 0 for a negative row. ANTEX 1.4, "Phase center corrections".
    """
    if row < 0:
        return 0.0
    flat = cos(elevation_rad)
    offset = pattern.offset_enu_m[row]
    along = offset[0] * flat * sin(azimuth_rad) + offset[1] * flat * cos(azimuth_rad) + offset[2] * sin(elevation_rad)
    azimuths, zeniths = pattern.variation_m.shape[1], pattern.variation_m.shape[2]
    z = min(max((0.5 * np.pi - elevation_rad) / pattern.zenith_step_rad, 0.0), zeniths - 1.0)
    j = min(int(z), zeniths - 2)
    if azimuths == 1:
        values = pattern.variation_m[row, 0]
        return values[j] + (values[j + 1] - values[j]) * (z - j) - along
    a = azimuth_rad / pattern.azimuth_step_rad
    a = a - (azimuths - 1) * floor(a / (azimuths - 1))
    i = min(int(a), azimuths - 2)
    near, far = pattern.variation_m[row, i], pattern.variation_m[row, i + 1]
    first = near[j] + (near[j + 1] - near[j]) * (z - j)
    second = far[j] + (far[j + 1] - far[j]) * (z - j)
    return first + (second - first) * (a - i) - along
