"""Pose, twist and heading of the body as ROS messages say them (REP-103, REP-105), without ROS."""

from math import degrees, nan, radians, sqrt

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.services.test_ros2_conversion import attitude

from rtkmesh.attitude.rotation import NED_FROM_ENU, quaternion_of, rotation_of, rotation_of_angles, rotation_of_quaternion, vector_of
from rtkmesh.gnss.frames import ecef_from_geodetic, enu_from_ecef, geodetic_from_ecef
from rtkmesh_schemas.attitude import AttitudeMessage, BodyPoint
from rtkmesh_services.ros2.conversion import Quaternion
from rtkmesh_services.ros2.pose import Map, heading_quaternion_of, pose_of, twist_of

ORIGIN_DEG_M = (52.5, 13.4, 80.0)
LAT_RAD, LON_RAD = radians(52.5), radians(13.4)
FLU_FROM_FRD = np.diag([1.0, -1.0, -1.0])
RNG = np.random.default_rng(1)
SPD = [a @ a.T for a in RNG.standard_normal((4, 3, 3))]


def rotation(q: Quaternion) -> np.ndarray:
    return rotation_of_quaternion(np.array([q[3], *q[:3]]))


def body(angles_rad: tuple[float, float, float], **changes: object) -> AttitudeMessage:
    ned_from_body = rotation_of_angles(*angles_rad)
    told = {
        "quaternion_enu_from_flu": tuple(quaternion_of(NED_FROM_ENU @ ned_from_body @ FLU_FROM_FRD).tolist()),
        "rotation_cov_ned_rad2": tuple(SPD[0].ravel().tolist()),
        "rate_radps": (0.1, 0.2, 0.3),
        "rate_cov_rad2ps2": tuple(SPD[1].ravel().tolist()),
    }
    return attitude(**told | changes)


def point_at(enu_m: np.ndarray, **changes: object) -> BodyPoint:
    ecef = ecef_from_geodetic(LAT_RAD, LON_RAD, 80.0) + enu_from_ecef(LAT_RAD, LON_RAD).T @ enu_m
    lat, lon, height = geodetic_from_ecef(ecef).tolist()
    told = {
        "position_ecef_m": tuple(ecef.tolist()),
        "lat_deg": degrees(lat),
        "lon_deg": degrees(lon),
        "height_m": height,
        "cov_enu_m2": tuple(SPD[2].ravel().tolist()),
        "velocity_enu_mps": (3.0, 4.0, 0.5),
        "velocity_cov_enu_m2ps2": tuple(SPD[3].ravel().tolist()),
    }
    return BodyPoint(**told | changes)


ANGLES = st.tuples(st.floats(0.0, 6.28), st.floats(-1.4, 1.4), st.floats(-3.1, 3.1))


@settings(max_examples=40, deadline=None)
@given(ANGLES, st.tuples(*[st.floats(-20e3, 20e3)] * 2, st.floats(-100.0, 1000.0)))
def test_the_pose_is_in_the_maps_axes(angles: tuple[float, float, float], place: tuple[float, float, float]) -> None:
    """Against the engine's frames: position, forward axis and covariances, also where east is another one than at the origin."""
    point = point_at(np.array(place))
    pose = pose_of(body(angles), point, Map(*ORIGIN_DEG_M))
    assert pose is not None
    assert pose.position == pytest.approx(place, abs=1e-5)
    turn = enu_from_ecef(LAT_RAD, LON_RAD) @ enu_from_ecef(radians(point.lat_deg), radians(point.lon_deg)).T
    expected = turn @ NED_FROM_ENU @ rotation_of_angles(*angles) @ FLU_FROM_FRD
    np.testing.assert_allclose(rotation(pose.quaternion), expected, atol=1e-9)
    cov = np.array(pose.covariance).reshape(6, 6)
    np.testing.assert_allclose(cov[:3, :3], turn @ SPD[2] @ turn.T, atol=1e-9)
    np.testing.assert_allclose(cov[3:, 3:], turn @ NED_FROM_ENU @ SPD[0] @ NED_FROM_ENU @ turn.T, atol=1e-9)
    assert not cov[:3, 3:].any()


def test_the_covariance_is_of_turns_about_the_maps_axes() -> None:
    """Drawn: attitudes turned in NED by errors of a covariance differ in the map by turns of the told one."""
    rng, small = np.random.default_rng(2), 1e-6 * SPD[0]
    half = np.linalg.cholesky(small)
    ned_from_body = rotation_of_angles(1.0, 0.2, -0.3)
    told = pose_of(body((1.0, 0.2, -0.3), rotation_cov_ned_rad2=tuple(small.ravel().tolist())), point_at(np.zeros(3)), Map(*ORIGIN_DEG_M))
    assert told is not None
    turns = []
    for _ in range(3000):
        turned = NED_FROM_ENU @ rotation_of(half @ rng.standard_normal(3)) @ ned_from_body @ FLU_FROM_FRD
        turns.append(vector_of(turned @ rotation(told.quaternion).T))
    np.testing.assert_allclose(np.cov(np.array(turns).T), np.array(told.covariance).reshape(6, 6)[3:, 3:], rtol=0.2, atol=2e-7)


@settings(max_examples=40, deadline=None)
@given(ANGLES)
def test_the_twist_is_in_the_bodys_axes(angles: tuple[float, float, float]) -> None:
    twist = twist_of(body(angles), point_at(np.zeros(3)))
    assert twist is not None
    flu_from_enu = (NED_FROM_ENU @ rotation_of_angles(*angles) @ FLU_FROM_FRD).T
    assert twist.linear == pytest.approx((flu_from_enu @ np.array([3.0, 4.0, 0.5])).tolist(), abs=1e-9)
    assert twist.angular == pytest.approx((0.1, -0.2, -0.3))
    cov = np.array(twist.covariance).reshape(6, 6)
    np.testing.assert_allclose(cov[:3, :3], flu_from_enu @ SPD[3] @ flu_from_enu.T, atol=1e-9)
    np.testing.assert_allclose(cov[3:, 3:], FLU_FROM_FRD @ SPD[1] @ FLU_FROM_FRD, atol=1e-9)


def test_heading_north_goes_north_and_forward() -> None:
    """By hand: a vehicle that points and drives north has yaw 90 deg and moves along its x."""
    point = point_at(np.zeros(3), velocity_enu_mps=(0.0, 2.0, 0.0))
    north = body((0.0, 0.0, 0.0), yaw_enu_rad=radians(90.0))
    pose, twist, heading = pose_of(north, point, Map(*ORIGIN_DEG_M)), twist_of(north, point), heading_quaternion_of(north)
    assert pose is not None
    assert twist is not None
    assert heading is not None
    assert pose.quaternion == pytest.approx((0.0, 0.0, sqrt(0.5), sqrt(0.5)))
    assert heading.quaternion == pytest.approx((0.0, 0.0, sqrt(0.5), sqrt(0.5)))
    assert twist.linear == pytest.approx((2.0, 0.0, 0.0), abs=1e-12)


@pytest.mark.parametrize(
    "changes", [{"integrity": "failed"}, {"quaternion_enu_from_flu": (nan,) * 4}, {"rotation_cov_ned_rad2": (nan,) * 9}]
)
def test_what_is_not_known_is_not_published(changes: dict[str, object]) -> None:
    assert pose_of(body((1.0, 0.0, 0.0), **changes), point_at(np.zeros(3)), Map(*ORIGIN_DEG_M)) is None
    assert pose_of(body((1.0, 0.0, 0.0)), BodyPoint(), Map(*ORIGIN_DEG_M)) is None
    assert twist_of(body((1.0, 0.0, 0.0)), point_at(np.zeros(3), velocity_enu_mps=(nan,) * 3)) is None
    assert heading_quaternion_of(attitude(integrity="failed")) is None


def test_rates_that_are_not_known_have_a_variance_that_says_so() -> None:
    twist = twist_of(body((1.0, 0.0, 0.0), rate_radps=(nan, nan, 0.1)), point_at(np.zeros(3)))
    assert twist is not None
    assert (twist.angular, twist.covariance[21], twist.covariance[35]) == ((0.0, 0.0, 0.0), 1e6, 1e6)
