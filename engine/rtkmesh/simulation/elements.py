"""Nominal constellations as mean elements at one fixed instant, derived from their published definitions.

GPS: 31 satellites in six planes (IS-GPS-200N, GPS SPS PS 2020 table 3.2-1: 55 degrees, 12 h sidereal). Galileo: Walker 24/3/1, 56 degrees
(OS SDD 1.3, 2.1.1). BeiDou-3: Walker 24/3/1, 55 degrees, and three IGSO (BDS OS PS 3.0, 2.2). GLONASS: 24/3/1, 64.8 degrees (ICD 5.1, 1.2).
What the definitions leave open (eccentricity, clocks, delays, harmonics) takes plausible values from a fixed sequence.
"""

from dataclasses import dataclass
from math import pi, radians
from typing import Final

from rtkmesh.gnss.signals import BEIDOU, GALILEO, GLONASS, GPS, SATELLITES_PER_SYSTEM
from rtkmesh.gnss.time import GpsTime

REFERENCE: Final = GpsTime(2400, 0.0)  # instant of all mean elements

_GOLDEN = 0.6180339887498949


@dataclass(frozen=True, slots=True)
class KeplerElements:
    """Orbit and clock of a GPS, Galileo or BeiDou satellite at ``REFERENCE``; ``node_rad`` is the longitude in ECEF of the ascending node.

    The clock rate is a multiple of the coarsest broadcast resolution, so that it is broadcast exactly.
    """

    satellite: int
    semi_major_m: float
    eccentricity: float
    inclination_rad: float
    node_rad: float
    perigee_rad: float
    mean_anomaly_rad: float
    node_rate_radps: float
    delta_n_radps: float
    harmonics: tuple[float, float, float, float, float, float]  # cuc, cus (rad), crc, crs (m), cic, cis (rad)
    clock_s: float
    clock_rate: float
    group_delay_s: tuple[float, float]


@dataclass(frozen=True, slots=True)
class CircularElements:
    """Orbit and clock of a GLONASS satellite at ``REFERENCE``: node longitude in ECEF and argument of latitude."""

    satellite: int
    channel: int
    node_rad: float
    latitude_argument_rad: float
    clock_s: float
    clock_rate: float
    group_delay_s: float


@dataclass(frozen=True, slots=True)
class _Shell:
    """One group of satellites of equal size and tilt."""

    system: int
    semi_major_m: float
    inclination_deg: float
    node_rate_radps: float
    delta_n_radps: float
    largest_eccentricity: float


_SHELLS: Final = {
    "gps": _Shell(GPS, 26_559_710.0, 55.0, -8.1e-9, 4.6e-9, 0.015),
    "galileo": _Shell(GALILEO, 29_599_801.0, 56.0, -5.6e-9, 3.1e-9, 0.0006),
    "beidou": _Shell(BEIDOU, 27_906_100.0, 55.0, -6.9e-9, 3.6e-9, 0.001),
    "igso": _Shell(BEIDOU, 42_164_169.0, 55.0, -1.9e-9, 1.1e-9, 0.004),
}
GLONASS_SEMI_MAJOR_M: Final = 25_508_200.0
GLONASS_INCLINATION_RAD: Final = radians(64.8)
GLONASS_PERIOD_S: Final = 40_544.0  # ICD 5.1, 1.2: 11 h 15 min 44 s
GLONASS_NODE_RATE_RADPS: Final = -6.8e-9
# Frequency channels by slot: antipodal satellites share one (public constellation status, unchanged for years).
_GLONASS_CHANNELS: Final = (1, -4, 5, 6, 1, -4, 5, 6, -2, -7, 0, -1, -2, -7, 0, -1, 4, -3, 3, 2, 4, -3, 3, 2)

_GPS_PLANES: Final = (6, 5, 5, 5, 5, 5)  # satellites per plane
_GPS_PLANE_PHASE_DEG: Final = 27.0  # spreads the planes' satellites in latitude
_GLONASS_PLANE_PHASE_DEG: Final = 15.0  # ICD 5.1, 1.2
_IGSO_CENTRE_DEG: Final = 118.0  # longitude of the common ground track


def _share(index: int, kind: int) -> float:
    """Return a number in [0, 1) that looks arbitrary and is always the same."""
    return ((index + 1) * (kind + 1) * _GOLDEN + 0.37 * kind) % 1.0


def _elements(shell: _Shell, number: int, node_deg: float, latitude_argument_deg: float) -> KeplerElements:
    """Return the elements of satellite ``number`` of a shell; the arbitrary values depend on system and number alone."""
    satellite = shell.system * SATELLITES_PER_SYSTEM + number
    vary = [_share(satellite, kind) for kind in range(9)]
    perigee = 2.0 * pi * vary[1]
    delay_s = (vary[2] - 0.5) * 2.0e-8
    return KeplerElements(
        satellite=satellite,
        semi_major_m=shell.semi_major_m,
        eccentricity=shell.largest_eccentricity * (0.1 + 0.9 * vary[0]),
        inclination_rad=radians(shell.inclination_deg + vary[3] - 0.5),
        node_rad=radians(node_deg),
        perigee_rad=perigee,
        mean_anomaly_rad=radians(latitude_argument_deg) - perigee,
        node_rate_radps=shell.node_rate_radps,
        delta_n_radps=shell.delta_n_radps,
        harmonics=(
            (vary[4] - 0.5) * 8e-6,
            (vary[5] - 0.5) * 1.6e-5,
            (vary[6] - 0.5) * 400.0,
            (vary[7] - 0.5) * 160.0,
            (vary[8] - 0.5) * 2e-7,
            (vary[0] - 0.5) * 2e-7,
        ),
        clock_s=(vary[6] - 0.5) * 6e-4,
        clock_rate=round((vary[4] - 0.5) * 8.0) * 2.0**-43,
        group_delay_s=(delay_s, 0.0) if shell.system == GPS else (delay_s, 1.3 * delay_s),
    )


def _gps() -> list[KeplerElements]:
    found: list[KeplerElements] = []
    for plane, count in enumerate(_GPS_PLANES):
        for slot in range(count):
            argument = 360.0 * slot / count + _GPS_PLANE_PHASE_DEG * plane
            found.append(_elements(_SHELLS["gps"], len(found) + 1, 60.0 * plane + 17.0, argument))
    return found


def _walker(shell: _Shell, first: int, node_deg: float) -> list[KeplerElements]:
    """Return a Walker 24/3/1 constellation: eight per plane, 15 degrees of phase from plane to plane."""
    return [
        _elements(shell, first + 8 * plane + slot, node_deg + 120.0 * plane, 45.0 * slot + 15.0 * plane)
        for plane in range(3)
        for slot in range(8)
    ]


def _igso() -> list[KeplerElements]:
    """Return three inclined geosynchronous satellites on one ground track, 8 h apart."""
    return [_elements(_SHELLS["igso"], 6 + k, _IGSO_CENTRE_DEG - 120.0 * k, 120.0 * k) for k in range(3)]


def _glonass() -> tuple[CircularElements, ...]:
    return tuple(
        CircularElements(
            satellite=GLONASS * SATELLITES_PER_SYSTEM + slot + 1,
            channel=channel,
            node_rad=radians(120.0 * (slot // 8) + 5.0),
            latitude_argument_rad=radians(45.0 * (slot % 8) + _GLONASS_PLANE_PHASE_DEG * (slot // 8)),
            clock_s=(_share(slot, 20) - 0.5) * 2e-4,
            clock_rate=round((_share(slot, 21) - 0.5) * 2.0) * 2.0**-40,
            group_delay_s=round((_share(slot, 22) - 0.5) * 12.0) * 2.0**-30,
        )
        for slot, channel in enumerate(_GLONASS_CHANNELS)
    )


KEPLER_SATELLITES: Final = tuple(
    sorted((*_gps(), *_walker(_SHELLS["galileo"], 1, 31.0), *_igso(), *_walker(_SHELLS["beidou"], 19, 74.0)), key=lambda e: e.satellite)
)
GLONASS_SATELLITES: Final = _glonass()
