"""The heading of a vehicle that drives forward, from its velocity."""

from dataclasses import dataclass
from math import atan2, hypot, inf, pi, radians, sqrt

import numpy as np
from numpy.typing import NDArray

from rtkmesh.attitude.filter_options import Trust

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

# A course is right by half a turn when the vehicle backs: it may start a filter, never overrule one.
COURSE: Trust = Trust(may_reset=False)


@dataclass(frozen=True, slots=True)
class CourseOptions:
    """When a course is a heading.

    ``min_speed_mps``: slower, it is none; ``sideslip_sigma_rad``: between where the vehicle points and where it goes;
    ``max_sigma_rad``: less sure than that, it is none either.
    """

    min_speed_mps: float = 1.0
    sideslip_sigma_rad: float = radians(3.0)
    max_sigma_rad: float = radians(10.0)


def course(velocity_enu_mps: Vector, cov_enu: Matrix, options: CourseOptions) -> tuple[float, float] | None:
    """Return heading (rad, clockwise from north, in [0, 2 pi)) and sigma of a vehicle that drives forward; None when too slow to tell.

    ``velocity_enu_mps`` (3) with its covariance (3x3, m2/s2). The sigma is the gradient's, as of any azimuth (seed_systems.md 3.4).
    """
    east, north = float(velocity_enu_mps[0]), float(velocity_enu_mps[1])
    speed = hypot(east, north)
    if not options.min_speed_mps <= speed < inf:
        return None
    gradient = np.array([north, -east]) / speed**2
    variance = float(gradient @ cov_enu[:2, :2] @ gradient) + options.sideslip_sigma_rad**2
    return (atan2(east, north) % (2.0 * pi), sqrt(variance)) if 0.0 < variance <= options.max_sigma_rad**2 else None
