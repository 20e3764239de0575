"""Delays of the troposphere (Saastamoinen, Niell) and the ionosphere (Klobuchar)."""

from math import cos, exp, pi, sin
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel_in_place
from rtkmesh.gnss.constants import SECONDS_PER_DAY, SPEED_OF_LIGHT_MPS
from rtkmesh.gnss.ephemeris import KlobucharParameters

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

RELATIVE_HUMIDITY: Final = 0.7
LOWEST_ELEVATION_RAD: Final = np.deg2rad(2.0)  # mapping functions are not used below; a satellite there is mapped as if it were here

# Where no stream has sent Klobuchar parameters: 5 ns at night (fixed in the model) and at the top of the day 12 ns more at the magnetic
# equator, falling to none at 70 degrees, as in quiet to middling years of the solar cycle. Our choice, right within the model's own 50 %.
DEFAULT_KLOBUCHAR: Final = (1.2e-8, 0.0, -8.0e-8, 0.0, 90000.0, 0.0, 0.0, 0.0)

# Columns of the troposphere above one place: zenith delays (m) and continued fractions of the mapping functions.
_DRY_M, _WET_M, _DRY_A, _DRY_B, _DRY_C, _WET_A, _WET_B, _WET_C, _HEIGHT_KM = range(9)
TROPOSPHERE: Final = 9

# Niell 1996 (J. Geophys. Res. 101 B2, 3227-3246), table 3: rows are hydrostatic a, b, c, their seasonal amplitudes, wet a, b, c; columns
# are latitudes 15, 30, 45, 60, 75 degrees.
_NIELL: Final = np.array([
    [1.2769934e-3, 1.2683230e-3, 1.2465397e-3, 1.2196049e-3, 1.2045996e-3],
    [2.9153695e-3, 2.9152299e-3, 2.9288445e-3, 2.9022565e-3, 2.9024912e-3],
    [62.610505e-3, 62.837393e-3, 63.721774e-3, 63.824265e-3, 64.258455e-3],
    [0.0, 1.2709626e-5, 2.6523662e-5, 3.4000452e-5, 4.1202191e-5],
    [0.0, 2.1414979e-5, 3.0160779e-5, 7.2562722e-5, 11.723375e-5],
    [0.0, 9.0128400e-5, 4.3497037e-5, 84.795348e-5, 170.37206e-5],
    [5.8021897e-4, 5.6794847e-4, 5.8118019e-4, 5.9727542e-4, 6.1641693e-4],
    [1.4275268e-3, 1.5138625e-3, 1.4572752e-3, 1.5007428e-3, 1.7599082e-3],
    [4.3472961e-2, 4.6729510e-2, 4.3908931e-2, 4.4626982e-2, 5.4736038e-2],
])  # fmt: skip
_NIELL_HEIGHT_A, _NIELL_HEIGHT_B, _NIELL_HEIGHT_C = 2.53e-5, 5.49e-3, 1.14e-3


@kernel_in_place
def zenith_hydrostatic_m(lat_rad: float, height_m: float) -> float:
    """Return the zenith hydrostatic delay (m) of the standard atmosphere; 0 above 40 km.

    Saastamoinen 1972, with the gravity term of Davis et al. 1985 equation A10; pressure of the International Standard Atmosphere.
    """
    if height_m > 40.0e3:
        return 0.0
    height_m = max(height_m, -1000.0)
    pressure_hpa = 1013.25 * (1.0 - 2.2557e-5 * height_m) ** 5.2568
    return 0.0022768 * pressure_hpa / (1.0 - 0.00266 * cos(2.0 * lat_rad) - 0.00028e-3 * height_m)


@kernel_in_place
def zenith_wet_m(height_m: float) -> float:
    """Return the zenith wet delay (m) of the standard atmosphere at a relative humidity of 0.7; 0 above the tropopause.

    Saastamoinen 1972: 0.002277 (1255 / T + 0.05) e; saturation pressure by the Magnus-type formula of the same source.
    """
    if height_m > 11.0e3:
        return 0.0
    temperature_k = 288.16 - 6.5e-3 * max(height_m, -1000.0)
    vapour_hpa = 6.108 * RELATIVE_HUMIDITY * exp((17.15 * temperature_k - 4684.0) / (temperature_k - 38.45))
    return 0.002277 * (1255.0 / temperature_k + 0.05) * vapour_hpa


@kernel_in_place
def day_of_year(week: int, tow_s: float) -> float:
    """Return the day of year with its fraction, 1.0 at the start of January 1, of a GPST instant between 1980 and 2099."""
    days = week * 7 + 5 + int(tow_s // SECONDS_PER_DAY)  # since 1980-01-01, the first day of a cycle of four years
    day = days % 1461
    if day >= 366:
        day = (day - 366) % 365
    return day + 1.0 + (tow_s % SECONDS_PER_DAY) / SECONDS_PER_DAY


@kernel_in_place
def troposphere_at(lat_rad: float, height_m: float, week: int, tow_s: float, out: Vector) -> None:
    """Write what the troposphere above a place at a time needs (TROPOSPHERE): zenith delays and mapping coefficients.

    Niell 1996 equations 4 to 6.
    """
    season = (day_of_year(week, tow_s) - 28.0) / 365.25 + (0.5 if lat_rad < 0.0 else 0.0)
    place = min(max(np.rad2deg(abs(lat_rad)) / 15.0 - 1.0, 0.0), 4.0)
    below = min(int(place), 3)
    part = place - below
    out[_DRY_M], out[_WET_M] = zenith_hydrostatic_m(lat_rad, height_m), zenith_wet_m(height_m)
    for k in range(3):
        mean = _NIELL[k, below] * (1.0 - part) + _NIELL[k, below + 1] * part
        amplitude = _NIELL[k + 3, below] * (1.0 - part) + _NIELL[k + 3, below + 1] * part
        out[_DRY_A + k] = mean - amplitude * cos(2.0 * pi * season)
        out[_WET_A + k] = _NIELL[k + 6, below] * (1.0 - part) + _NIELL[k + 6, below + 1] * part
    out[_HEIGHT_KM] = min(max(height_m, -1000.0), 40.0e3) * 1e-3


@kernel_in_place
def hydrostatic_mapping(troposphere: Vector, elevation_rad: float) -> float:
    """Return slant over zenith hydrostatic delay (Niell 1996, equations 4 and 6)."""
    sin_el = sin(max(elevation_rad, LOWEST_ELEVATION_RAD))
    surface = _continued_fraction(sin_el, troposphere[_DRY_A], troposphere[_DRY_B], troposphere[_DRY_C])
    by_height = 1.0 / sin_el - _continued_fraction(sin_el, _NIELL_HEIGHT_A, _NIELL_HEIGHT_B, _NIELL_HEIGHT_C)
    return surface + by_height * troposphere[_HEIGHT_KM]


@kernel_in_place
def wet_mapping(troposphere: Vector, elevation_rad: float) -> float:
    """Return slant over zenith wet delay (Niell 1996, equation 4)."""
    sin_el = sin(max(elevation_rad, LOWEST_ELEVATION_RAD))
    return _continued_fraction(sin_el, troposphere[_WET_A], troposphere[_WET_B], troposphere[_WET_C])


@kernel_in_place
def _continued_fraction(sin_el: float, a: float, b: float, c: float) -> float:
    """Marini's continued fraction, normalised to 1 at the zenith (Niell 1996, equation 4)."""
    return (1.0 + a / (1.0 + b / (1.0 + c))) / (sin_el + a / (sin_el + b / (sin_el + c)))


@kernel_in_place
def troposphere_m(troposphere: Vector, elevation_rad: float) -> float:
    """Return the slant delay (m) in the direction of an elevation."""
    dry, wet = troposphere[_DRY_M], troposphere[_WET_M]
    return dry * hydrostatic_mapping(troposphere, elevation_rad) + wet * wet_mapping(troposphere, elevation_rad)


def klobuchar_vector(parameters: KlobucharParameters | None) -> Vector:
    """Return alpha and beta (8) for the kernels; DEFAULT_KLOBUCHAR without parameters.

    BeiDou's own eight numbers belong to another mapping function and pole; they serve here only if nothing else came.
    """
    return np.array(DEFAULT_KLOBUCHAR if parameters is None else (*parameters.alpha, *parameters.beta))


@kernel_in_place
def ionosphere_l1_m(klobuchar: Vector, lat_rad: float, lon_rad: float, azimuth_rad: float, elevation_rad: float, tow_s: float) -> float:
    """Return the slant delay (m) at 1575.42 MHz by Klobuchar's model; at f it is (1575.42 MHz / f)^2 of this.

    IS-GPS-200N 20.3.3.5.2.5, figure 20-4; angles there are in semicircles.
    """
    elevation = max(elevation_rad, 0.0) / pi
    psi = 0.0137 / (elevation + 0.11) - 0.022
    lat = min(max(lat_rad / pi + psi * cos(azimuth_rad), -0.416), 0.416)
    lon = lon_rad / pi + psi * sin(azimuth_rad) / cos(lat * pi)
    lat_magnetic = lat + 0.064 * cos((lon - 1.617) * pi)
    amplitude_s, period_s = 0.0, 0.0
    for k in range(3, -1, -1):
        amplitude_s = amplitude_s * lat_magnetic + klobuchar[k]
        period_s = period_s * lat_magnetic + klobuchar[k + 4]
    amplitude_s, period_s = max(amplitude_s, 0.0), max(period_s, 72000.0)
    local_s = (4.32e4 * lon + tow_s) % SECONDS_PER_DAY
    x = 2.0 * pi * (local_s - 50400.0) / period_s
    slant = 1.0 + 16.0 * (0.53 - elevation) ** 3
    vertical_s = 5e-9 + (amplitude_s * (1.0 - x * x / 2.0 + x**4 / 24.0) if abs(x) < 1.57 else 0.0)
    return SPEED_OF_LIGHT_MPS * slant * vertical_s
