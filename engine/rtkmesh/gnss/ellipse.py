"""The ellipse of a horizontal covariance."""

from math import atan2, degrees, hypot, sqrt
from typing import NamedTuple


class ErrorEllipse(NamedTuple):
    """One sigma: half axes (m) and the larger one's direction from true north (degrees, 0 to 180)."""

    major_m: float
    minor_m: float
    direction_deg: float


def error_ellipse(north_m2: float, east_m2: float, north_east_m2: float) -> ErrorEllipse:
    """Return the ellipse of a horizontal covariance (its eigenvalues and eigenvectors in closed form)."""
    mean, half = (north_m2 + east_m2) / 2.0, (north_m2 - east_m2) / 2.0
    spread = hypot(half, north_east_m2)
    direction_deg = degrees(atan2(north_east_m2, half) / 2.0) % 180.0
    return ErrorEllipse(sqrt(max(mean + spread, 0.0)), sqrt(max(mean - spread, 0.0)), direction_deg)
