"""Points of a body by the filtered attitude: where they are without an attitude of the epoch itself, and how fast they move."""

from math import degrees

import msgspec
import numpy as np
from numpy.typing import NDArray

from rtkmesh.attitude.filter_options import Estimate
from rtkmesh.attitude.rotation import NED_FROM_ENU, skew
from rtkmesh.gnss.frames import geodetic_from_ecef
from rtkmesh_schemas.attitude import NAN9, BodyPoint
from rtkmesh_services.attitude.body import BodyAttitude
from rtkmesh_services.attitude.motion import velocity_of
from rtkmesh_services.attitude.readings import Reading, SourceKind

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Places = dict[str, tuple[float, float, float]]


def placed(point: BodyPoint, position_ecef_m: Vector, cov_ned_m2: Matrix) -> BodyPoint:
    """Return a point with where it is; a covariance that is not known stays NaN."""
    lat_rad, lon_rad, height_m = geodetic_from_ecef(position_ecef_m).tolist()
    cov_enu = NED_FROM_ENU @ cov_ned_m2 @ NED_FROM_ENU
    x, y, z = position_ecef_m.tolist()
    return msgspec.structs.replace(
        point,
        position_ecef_m=(x, y, z),
        lat_deg=degrees(lat_rad),
        lon_deg=degrees(lon_rad),
        height_m=height_m,
        cov_enu_m2=tuple(cov_enu.ravel().tolist()) if np.isfinite(cov_enu).all() else NAN9,
    )


def filtered_points(
    points: Places, found: BodyAttitude, told: dict[str, BodyPoint], estimate: Estimate, antennas: dict[str, Vector]
) -> dict[str, BodyPoint]:
    """Return the points of an epoch: as it tells them, else from the first position by the filtered attitude; and their velocities.

    ``told``: what the epoch itself says; ``antennas``: their places in the body (m).
    """
    rotation = estimate.ned_from_body
    if rotation is None:
        return dict(told)
    positions = [reading for reading in found.readings if reading.source.kind is SourceKind.POSITION and reading.source.end in antennas]
    return {name: _point(np.array(place), positions, found, told.get(name), estimate, antennas) for name, place in points.items()}


def _point(
    place: Vector, positions: list[Reading], found: BodyAttitude, told: BodyPoint | None, estimate: Estimate, antennas: dict[str, Vector]
) -> BodyPoint:
    point = BodyPoint() if told is None else told
    if not positions:
        return point
    if not np.isfinite(point.height_m):
        point = _by_antenna(point, place - antennas[positions[0].source.end], positions[0], found, estimate)
    moving = [_velocity(reading, place - antennas[reading.source.end], estimate) for reading in positions]
    known = [each for each in moving if each is not None]
    if not known:
        return point
    velocity, cov = (np.mean([each[part] for each in known], axis=0) for part in (0, 1))  # they share the base's and the sky's errors
    x, y, z = velocity.tolist()
    return msgspec.structs.replace(point, velocity_enu_mps=(x, y, z), velocity_cov_enu_m2ps2=tuple(cov.ravel().tolist()))


def _by_antenna(point: BodyPoint, arm_m: Vector, reading: Reading, found: BodyAttitude, estimate: Estimate) -> BodyPoint:
    if reading.edge is None or found.origin_ecef_m is None or found.ned_from_ecef is None or estimate.ned_from_body is None:
        return point
    arm = estimate.ned_from_body @ arm_m
    cross = skew(arm)
    cov = reading.edge.cov_m2 + cross @ estimate.cov_rad2 @ cross.T
    return placed(point, found.origin_ecef_m + found.ned_from_ecef.T @ (reading.edge.vector_ned_m + arm), cov)


def _velocity(reading: Reading, arm_m: Vector, estimate: Estimate) -> tuple[Vector, Matrix] | None:
    """Return velocity (ENU, m/s) and covariance of a point off an antenna: that of the antenna and the turn about it."""
    velocity, rotation = velocity_of(reading), estimate.ned_from_body
    if velocity is None or rotation is None or not np.isfinite(estimate.rate_cov_radps2).all():
        return None
    enu_from_body = NED_FROM_ENU @ rotation
    turned, cross = enu_from_body @ np.cross(estimate.rate_body_radps, arm_m), enu_from_body @ skew(arm_m)
    return velocity.enu_mps + turned, velocity.cov + cross @ estimate.rate_cov_radps2 @ cross.T
