"""Height of the geoid: EGM96 at whole degrees with straight lines between, the model that RTKLIB carries inside.

The table is NGA's EGM96 (public domain) in RTKLIB's millimetres; benchmarks/geoid_table.py made the file.
"""

import lzma
import sys
from array import array
from functools import lru_cache
from importlib.resources import files
from itertools import accumulate
from math import degrees
from typing import Final

_PARALLELS: Final = 181
_MERIDIANS: Final = 361
_MILLIMETRES: Final = 1000.0


def geoid_height_m(lat_rad: float, lon_rad: float) -> float:
    """Return the height of the geoid above the ellipsoid (m), as RTKLIB's geoidh with its internal model: 0 in a place that is none."""
    lat_deg, lon_deg = degrees(lat_rad), degrees(lon_rad)
    if lon_deg < 0.0:
        lon_deg += 360.0
    if not (0.0 <= lon_deg <= 360.0 - 1e-12 and -90.0 <= lat_deg <= 90.0):
        return 0.0
    column, row = int(lon_deg), int(lat_deg + 90.0)
    a, b = lon_deg - column, lat_deg + 90.0 - row
    north = min(row + 1, _PARALLELS - 1)
    return _bilinear(row * _MERIDIANS + column, north * _MERIDIANS + column, a, b)


def _bilinear(south: int, north: int, a: float, b: float) -> float:
    table = _heights_m()
    lower = table[south] * (1.0 - a) * (1.0 - b) + table[south + 1] * a * (1.0 - b)
    return lower + table[north] * (1.0 - a) * b + table[north + 1] * a * b


@lru_cache(maxsize=1)
def _heights_m() -> "array[float]":
    """Return the heights, parallel by parallel from the south, in the single precision that RTKLIB has them in."""
    steps = array("h", lzma.decompress((files("rtkmesh_services.texts") / "egm96.xz").read_bytes()))
    if sys.byteorder == "little":
        steps.byteswap()
    heights, first = array("f"), 0
    for start in range(0, _PARALLELS * _MERIDIANS, _MERIDIANS):
        first += steps[start]
        row = accumulate(steps[start + 1 : start + _MERIDIANS], initial=first)
        heights.extend(height / _MILLIMETRES for height in row)
    return heights
