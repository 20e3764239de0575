"""Where a rover is, as casters want to know it."""

from typing import NamedTuple


class Place(NamedTuple):
    """Degrees, metres above the ellipsoid."""

    lat_deg: float
    lon_deg: float
    height_m: float = 0.0
