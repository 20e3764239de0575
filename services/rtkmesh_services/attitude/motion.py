"""How a vehicle moves, from the velocities of one of its positions: its acceleration, and its course."""

from collections import deque
from dataclasses import dataclass
from math import exp, inf, sqrt

import numpy as np
from numpy.typing import NDArray

from rtkmesh.attitude.course import CourseOptions, course
from rtkmesh.attitude.filter_options import Estimate
from rtkmesh.attitude.rotation import NED_FROM_ENU
from rtkmesh.gnss.time import GpsTime
from rtkmesh_services.attitude.readings import Reading

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

_KEPT = 64
_TOLERANCE_S = 0.06  # of the ends of an interval whose acceleration is asked for
_LONGEST_S = 2.5
_UNSEEN_MPS2 = 0.15  # one sigma: what the mean between two velocities does not show of the acceleration at another place of the body
_SIDESLIP_S = 5.0  # how long a vehicle slips


@dataclass(frozen=True, slots=True, eq=False)
class Velocity:
    """Velocity (ENU, m/s) with covariance at an instant."""

    time: GpsTime
    enu_mps: Vector
    cov: Matrix


def velocity_of(reading: Reading) -> Velocity | None:
    """Return the velocity of a position; None when it has none."""
    enu, cov = np.array(reading.velocity_enu_mps), np.array(reading.velocity_cov_enu_m2ps2)
    if not (np.isfinite(enu).all() and len(cov) == 9 and np.isfinite(cov).all()):
        return None
    return Velocity(reading.time, enu, cov.reshape(3, 3))


class Motion:
    """The recent velocities of one position."""

    def __init__(self) -> None:
        self._past: deque[Velocity] = deque(maxlen=_KEPT)

    def take(self, velocity: Velocity) -> None:
        """Take a velocity; a step back in time begins anew."""
        if self._past and velocity.time <= self._past[-1].time:
            self._past.clear()
        self._past.append(velocity)

    def reaches(self, time: GpsTime) -> bool:
        """Return whether there is a velocity at a time, or after it."""
        return bool(self._past) and self._past[-1].time - time >= -_TOLERANCE_S

    def acceleration_ned(self, start: GpsTime, end: GpsTime) -> tuple[Vector, float] | None:
        """Return the mean acceleration (NED, m/s2) over an interval and the sigma of one axis; None when velocities do not tell."""
        before = next((v for v in reversed(self._past) if v.time - start <= _TOLERANCE_S), None)
        after = next((v for v in self._past if v.time - end >= -_TOLERANCE_S), None)
        if before is None or after is None or not 0.0 < after.time - before.time <= _LONGEST_S:
            return None
        between_s = after.time - before.time
        mean = NED_FROM_ENU @ (after.enu_mps - before.enu_mps) / between_s
        variance = float(np.trace(before.cov[:2, :2] + after.cov[:2, :2])) / 2.0 / between_s**2
        return mean, sqrt(variance + _UNSEEN_MPS2**2)


class Courses:
    """Headings from velocities of an antenna at a place of the body (forward, right, down, m) of a vehicle that goes where it points."""

    def __init__(self, options: CourseOptions, place_m: Vector) -> None:
        self._options, self._place = options, place_m
        self._last: GpsTime | None = None

    def heading(self, velocity: Velocity, estimate: Estimate) -> tuple[float, float] | None:
        """Return heading (rad) and sigma, if it tells one. The antenna's own motion about the origin, as far as it is known, is left out.

        A slip lasts for seconds: values that follow each other quickly count for less.
        """
        found = course(self._of_origin(velocity, estimate), velocity.cov, self._options)
        if found is None:
            return None
        since_s = inf if self._last is None else velocity.time - self._last
        self._last = velocity.time
        rho = exp(-since_s / _SIDESLIP_S) if since_s > 0.0 else 0.0
        slip = self._options.sideslip_sigma_rad**2
        return found[0], sqrt(found[1] ** 2 - slip + slip * (1.0 + rho) / (1.0 - rho))

    def _of_origin(self, velocity: Velocity, estimate: Estimate) -> Vector:
        if estimate.ned_from_body is None:
            return velocity.enu_mps
        rate = np.nan_to_num(estimate.rate_body_radps)
        return velocity.enu_mps - NED_FROM_ENU @ estimate.ned_from_body @ np.cross(rate, self._place)
