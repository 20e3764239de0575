"""One antenna, its course and an IMU: the whole attitude of a vehicle that drives, on the in-memory bus, with truth."""

from collections.abc import Callable
from dataclasses import dataclass
from math import degrees, isnan

import msgspec
import numpy as np
import pytest
from tests.services.attitude_body import ECEF_FROM_ENU, ORIGIN_ECEF_M, WEEK, Vehicle, solution

from rtkmesh.attitude.rotation import NED_FROM_ENU, rotation_of_angles, rotation_of_quaternion, vector_of
from rtkmesh.simulation.trajectories import Trajectory, driving
from rtkmesh_schemas.attitude import AttitudeMessage
from rtkmesh_schemas.config_attitude import AttitudeFilterTable, BodyPointTable, CourseTable, ImuTable
from rtkmesh_schemas.keys import ATT_FILTERED
from rtkmesh_services.runtime.bus import Sample

PLACE_M = (0.8, 0.2, -1.5)
GRAVITY_NED = np.array([0.0, 0.0, 9.81])
RATE_SIGMA_RADPS, FORCE_SIGMA_MPS2, VELOCITY_SIGMA_MPS = 0.003, 0.05, 0.02
BIAS_RADPS, FORCE_BIAS_MPS2 = np.array([0.004, -0.003, 0.005]), np.array([0.05, -0.04, 0.03])
Array = np.ndarray


def rotation_at(drive: Trajectory, time_s: float) -> Array:
    pose = drive(time_s)
    return rotation_of_angles(pose.heading_rad, pose.pitch_rad, pose.roll_rad)


def place_at(drive: Trajectory, time_s: float, place_m: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Array:
    """Where a place of the body is in NED."""
    return NED_FROM_ENU @ np.array(drive(time_s).position_enu_m) + rotation_at(drive, time_s) @ np.array(place_m)


@dataclass(slots=True)
class Drive:
    """A vehicle with one antenna, and what its solver and its IMU say of a drive."""

    vehicle: Vehicle
    drive: Trajectory
    rng: np.random.Generator

    def imu(self, time_s: float, **fields: object) -> None:
        """Rates and specific force of the body's origin, with noise and biases; an accelerometer feels what the vehicle does."""
        h, rotation = 0.01, rotation_at(self.drive, time_s)
        rate = vector_of(rotation_at(self.drive, time_s - h).T @ rotation_at(self.drive, time_s + h)) / (2.0 * h)
        here = place_at(self.drive, time_s)
        acceleration = (place_at(self.drive, time_s + h) - 2.0 * here + place_at(self.drive, time_s - h)) / h**2
        force = rotation.T @ (acceleration - GRAVITY_NED)
        told = {
            "rate_radps": (rate + BIAS_RADPS + RATE_SIGMA_RADPS * self.rng.standard_normal(3)).tolist(),
            "force_mps2": (force + FORCE_BIAS_MPS2 + FORCE_SIGMA_MPS2 * self.rng.standard_normal(3)).tolist(),
            "week": WEEK,
            "tow_s": 1000.0 + time_s,
        }
        payload = msgspec.json.encode(told | fields)
        self.vehicle.service.handle(Sample("vehicle/imu", payload, "application/json", b"", 0))

    def position(self, time_s: float) -> None:
        """The kinematic solver's position and velocity of the antenna."""
        h = 0.01
        ned = (place_at(self.drive, time_s + h, PLACE_M) - place_at(self.drive, time_s - h, PLACE_M)) / (2.0 * h)
        enu = NED_FROM_ENU @ ned + VELOCITY_SIGMA_MPS * self.rng.standard_normal(3)
        ecef = ORIGIN_ECEF_M + ECEF_FROM_ENU @ NED_FROM_ENU @ place_at(self.drive, time_s, PLACE_M)
        cov = tuple((VELOCITY_SIGMA_MPS**2 * np.eye(3)).ravel().tolist())
        told = {"position_ecef_m": tuple(ecef.tolist()), "position_cov_enu_m2": tuple((1e-4 * np.eye(3)).ravel().tolist())}
        velocity = {"velocity_enu_mps": tuple(enu.tolist()), "velocity_cov_enu_m2ps2": cov}
        velocity["velocity_ecef_mps"] = tuple((ECEF_FROM_ENU @ enu).tolist())
        self.vehicle.say("pa", solution(source="pa", tow_s=1000.0 + time_s, **told, **velocity))

    def run(
        self, start_s: float, seconds: float, position: Callable[[float], bool] = lambda _: True
    ) -> list[tuple[float, AttitudeMessage]]:
        """Drive; return the filtered attitudes with the drive's own time. ``position``: whether there are positions at a time."""
        before = len(self.vehicle.bus.sent(ATT_FILTERED))
        for k in range(round(seconds * 25.0)):
            self.imu(start_s + 0.04 * k)
            if k % 5 == 0 and position(start_s + 0.04 * k):
                self.position(start_s + 0.04 * k)
        return [(message.tow_s - 1000.0, message) for message in self.vehicle.attitudes(ATT_FILTERED)[before:]]


def driven(seed: int = 1, **table: object) -> Drive:
    options: dict[str, object] = {
        "solvers": (),
        "positions": ("pa",),
        "filter": AttitudeFilterTable(publish="gyro"),
        "imu": ImuTable(key="vehicle/imu", sigma_radps=RATE_SIGMA_RADPS),
        "course": CourseTable(position="pa", sideslip_deg=1.0),
    }
    return Drive(Vehicle({"a": PLACE_M}, **options | table), driving, np.random.default_rng(seed))


def off_of(drive: Drive, found: list[tuple[float, AttitudeMessage]]) -> tuple[Array, Array]:
    """Errors (n, 3; about north, east, down, rad) and squares in units of covariance per degree of freedom."""
    errors, squares = [], []
    for time_s, message in found:
        error = vector_of(rotation_at(drive.drive, time_s) @ rotation_of_quaternion(np.array(message.quaternion_ned_from_body)).T)
        errors.append(error)
        squares.append(error @ np.linalg.solve(np.array(message.rotation_cov_ned_rad2).reshape(3, 3), error) / 3.0)
    return np.array(errors), np.array(squares)


def test_a_single_antenna_with_an_imu_has_the_whole_attitude() -> None:
    """It starts with the course once it drives, keeps the heading while it stands; its tilt is gravity's although it brakes and turns."""
    drive = driven()
    found = drive.run(2.0, 60.0)
    known = [(time_s, m) for time_s, m in found if m.integrity == "ok"]
    assert isnan(found[0][1].heading_rad)
    late = [(time_s, m) for time_s, m in known if time_s > 30.0]
    assert len(late) > 0.95 * 5 * 32
    errors, squares = off_of(drive, late)
    heading_deg, tilt_deg = degrees(np.sqrt(np.mean(errors[:, 2] ** 2))), degrees(np.sqrt(np.mean(errors[:, :2] ** 2)))
    print(f"heading {heading_deg:.2f} deg, tilt {tilt_deg:.2f} deg, NEES {squares.mean():.2f}")
    assert heading_deg < 1.5
    assert tilt_deg < 1.5
    assert 0.05 < squares.mean() < 1.7
    counters = drive.vehicle.service.report().counters
    assert counters["filter_course_accepted"] > 50
    assert counters["filter_tilt_accepted"] > 50
    assert "filter_course_reset" not in counters


def test_a_point_of_the_body_is_where_the_filtered_attitude_has_it_and_moves_as_it_turns() -> None:
    """A point behind and below the antenna; its velocity is not the antenna's in a turn. At epochs only."""
    place = (-1.5, -0.5, 0.3)
    drive = driven(points={"hitch": BodyPointTable(position_m=place)})
    found = [(t, m.points["hitch"]) for t, m in drive.run(2.0, 45.0) if m.integrity == "ok" and "hitch" in m.points and t > 25.0]
    assert 90 < len(found) < 110
    off_m, off_mps, antenna_mps, h = [], [], [], 0.01
    for time_s, point in found:
        truth = place_at(drive.drive, time_s, place)
        told = NED_FROM_ENU @ ECEF_FROM_ENU.T @ (np.array(point.position_ecef_m) - ORIGIN_ECEF_M)
        velocity = (place_at(drive.drive, time_s + h, place) - place_at(drive.drive, time_s - h, place)) / (2.0 * h)
        antenna = (place_at(drive.drive, time_s + h, PLACE_M) - place_at(drive.drive, time_s - h, PLACE_M)) / (2.0 * h)
        off_m.append((told - truth) / np.sqrt(np.array(point.cov_enu_m2)[[4, 0, 8]]))
        off_mps.append(np.linalg.norm(NED_FROM_ENU @ np.array(point.velocity_enu_mps) - velocity))
        antenna_mps.append(np.linalg.norm(antenna - velocity))
    assert np.sqrt(np.mean(np.square(off_m))) < 1.5
    assert np.mean(off_mps) < 0.08 < 0.5 * np.max(antenna_mps)


def test_without_the_course_table_a_velocity_is_no_heading() -> None:
    """Off by default."""
    found = driven(course=None).run(2.0, 12.0)
    assert all(isnan(message.heading_rad) for _, message in found)


@pytest.mark.parametrize("seed", [2, 3])
def test_tilt_is_honest_without_positions(seed: int) -> None:
    """In a tunnel accelerations are not known: sigmas are larger, errors within them."""
    drive = driven(seed)
    found = drive.run(2.0, 45.0, lambda time_s: time_s < 30.0)
    open_ = [(t, m) for t, m in found if 20.0 < t < 30.0 and m.integrity == "ok"]
    tunnel = [(t, m) for t, m in found if t > 38.0 and m.integrity == "ok"]
    assert len(tunnel) > 50
    _, squares = off_of(drive, tunnel)
    assert squares.mean() < 2.0
    assert tunnel[-1][1].rotation_cov_ned_rad2[8] > open_[-1][1].rotation_cov_ned_rad2[8]


def test_growth_of_an_imus_own_yaw_turns_the_heading_filter() -> None:
    """Only the kind heading has it; the other says that it does not use it."""
    drive = driven(filter=AttitudeFilterTable(kind="heading", publish="gyro"))
    drive.run(2.0, 10.0)
    drive.imu(12.04, rate_radps=None, force_mps2=None, yaw_increment_rad=0.01, interval_s=0.04)
    assert drive.vehicle.service.report().counters["filter_yaw_accepted"] == 1
    other = driven()
    other.run(2.0, 3.0)
    other.imu(5.04, rate_radps=None, force_mps2=None, yaw_increment_rad=0.01, interval_s=0.04)
    assert other.vehicle.service.report().counters["filter_yaw_not_used"] == 1
