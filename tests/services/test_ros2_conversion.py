"""Our messages become ROS messages by the conventions of REP-103, REP-145 and sensor_msgs, without ROS."""

from datetime import UTC, datetime
from math import cos, isnan, nan, pi, radians, sin

import msgspec
import pytest

from rtkmesh_schemas.attitude import AttitudeMessage
from rtkmesh_schemas.solution import SolutionMessage
from rtkmesh_schemas.status import InputStatus, ServiceStatus, State
from rtkmesh_services.ros2.conversion import STALE, WARN, diagnostic_of, fix_of, orientation_of, stamp_of, velocity_of

NAN3 = (nan, nan, nan)
COV = (4.0, 1.0, 0.5, 1.0, 9.0, 0.2, 0.5, 0.2, 16.0)


def solution(**changes: object) -> SolutionMessage:
    values = {
        "source": "rtk", "start_id": "x", "sequence": 1, "week": 2200, "tow_s": 345600.2, "status": 1, "status_name": "FIX", "reason": "ok",
        "lat_deg": 35.0, "lon_deg": 139.0, "height_m": 40.5, "position_ecef_m": (1.0, 2.0, 3.0), "position_cov_ecef_m2": COV,
        "position_cov_enu_m2": COV, "velocity_ecef_mps": NAN3, "velocity_cov_ecef_m2ps2": COV, "velocity_enu_mps": (1.0, 2.0, 0.1),
        "velocity_cov_enu_m2ps2": COV, "base_ecef_m": NAN3, "baseline_ecef_m": NAN3, "baseline_enu_m": NAN3, "baseline_cov_enu_m2": COV,
        "age_s": 0.0, "ratio": 20.0, "ratio_threshold": 2.0, "success_rate": 1.0, "grade": 3, "ambiguities": 20, "ambiguities_fixed": 18,
        "satellites_used": 12, "satellites_rover": 14, "satellites_base": 15, "code_rms_m": 0.3, "phase_rms_m": 0.002,
        "nis_per_observation": 0.9, "receiver_clock_s": 0.0, "resets": 0, "mode": "kinematic",
    }  # fmt: skip
    return SolutionMessage(**(values | changes))


def attitude(**changes: object) -> AttitudeMessage:
    values = {
        "source": "heading", "start_id": "x", "sequence": 1, "week": 2200, "tow_s": 1.0, "status": 1, "status_name": "FIX",
        "integrity": "ok", "reason": "", "heading_rad": radians(30.0), "pitch_rad": radians(5.0), "roll_rad": nan,
        "yaw_enu_rad": radians(60.0), "covariance_rad2": (1e-6, 2e-7, nan, 2e-7, 4e-6, nan, nan, nan, nan),
        "baseline_length_m": 1.0, "length_error_m": 0.0, "antennas": ["a", "b"],
    }  # fmt: skip
    return AttitudeMessage(**(values | changes))


def test_the_stamp_is_utc() -> None:
    """2018-07-14 23:50:00 GPST is 23:49:42 UTC (18 leap seconds)."""
    stamp = stamp_of(2009, 604200.25)
    assert (stamp.sec, stamp.nanosec) == (int(datetime(2018, 7, 14, 23, 49, 42, tzinfo=UTC).timestamp()), 250_000_000)


@pytest.mark.parametrize(("status", "expected"), [(1, 2), (2, 2), (4, 2), (5, 0)])
def test_statuses(status: int, expected: int) -> None:
    fix = fix_of(solution(status=status))
    assert (fix.status, fix.position_covariance_type, fix.position_covariance) == (expected, 3, COV)
    assert (fix.latitude, fix.longitude, fix.altitude, fix.service) == (35.0, 139.0, 40.5, 15)


def test_no_solution_is_no_fix_with_nan_never_an_old_or_zero_position() -> None:
    fix = fix_of(solution(status=0, lat_deg=nan, lon_deg=nan, height_m=nan, position_cov_enu_m2=(nan,) * 9))
    assert fix.status == -1
    assert isnan(fix.latitude)
    assert fix.position_covariance_type == 0


def test_velocity_has_its_full_covariance_in_the_6x6() -> None:
    velocity = velocity_of(solution())
    assert velocity is not None
    assert velocity.linear == (1.0, 2.0, 0.1)
    assert [velocity.covariance[6 * r + c] for r in range(3) for c in range(3)] == list(COV)
    assert velocity_of(solution(velocity_enu_mps=NAN3)) is None


def test_heading_30_degrees_is_yaw_60_and_nose_up_is_negative_pitch() -> None:
    orientation = orientation_of(attitude())
    assert orientation is not None
    x, y, z, w = orientation.quaternion
    forward = (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y))
    assert forward == pytest.approx((sin(radians(30)) * cos(radians(5)), cos(radians(30)) * cos(radians(5)), sin(radians(5))), abs=1e-12)
    assert (orientation.covariance[8], orientation.covariance[4]) == (1e-6, 4e-6)
    assert orientation.covariance[0] == pytest.approx((pi / 2) ** 2)


def test_the_whole_attitude_has_its_quaternion_rates_and_every_covariance() -> None:
    """Signs of (heading, nose up, roll) to (roll, FLU pitch, ENU yaw), by the derivative of each."""
    cov = ((4.0, 0.5, 0.3), (0.5, 9.0, 0.7), (0.3, 0.7, 16.0))
    orientation = orientation_of(
        attitude(
            roll_rad=radians(-3.0),
            covariance_rad2=tuple(value for row in cov for value in row),
            quaternion_enu_from_flu=(0.5, -0.5, 0.5, -0.5),
            rate_radps=(0.1, 0.2, 0.3),
            rate_cov_rad2ps2=(1.0, 2.0, 3.0, 2.0, 4.0, 5.0, 3.0, 5.0, 6.0),
        )
    )
    assert orientation is not None
    assert orientation.quaternion == (-0.5, 0.5, -0.5, 0.5)
    assert orientation.covariance == (16.0, -0.7, -0.3, -0.7, 9.0, 0.5, -0.3, 0.5, 4.0)
    assert orientation.rate == (0.1, -0.2, -0.3)
    assert orientation.rate_covariance == (1.0, -2.0, -3.0, -2.0, 4.0, 5.0, -3.0, 5.0, 6.0)
    assert orientation_of(attitude()).rate is None  # pyright: ignore[reportOptionalMemberAccess]  it has one


@pytest.mark.parametrize("changes", [{"integrity": "failed"}, {"integrity": "unavailable", "yaw_enu_rad": nan}])
def test_an_attitude_without_integrity_is_not_published(changes: dict[str, object]) -> None:
    assert orientation_of(attitude(**changes)) is None


def test_diagnostics_tell_state_and_figures() -> None:
    status = ServiceStatus(
        id="rtk", role="solver", state=State.RUNNING, start_id="x", heartbeat=3, inputs=[InputStatus(name="rover", state="receiving")]
    )
    diagnostic = diagnostic_of(status, solution())
    assert (diagnostic.level, diagnostic.message, diagnostic.name) == (0, "FIX", "rtkmesh/solver: rtk")
    assert dict(diagnostic.values)["ambiguities_fixed"] == "18/20"
    assert diagnostic_of(status, solution(status=5, status_name="SINGLE")).level == WARN
    failed = diagnostic_of(
        status, solution(integrity="failed", integrity_reason="codes", fix_probability=0.99, protection_horizontal_m=0.25)
    )
    assert (failed.level, failed.message) == (WARN, "FIX, integrity failed: codes")
    assert dict(failed.values)["protection_horizontal_m"] == "0.250"
    assert diagnostic_of(msgspec.structs.replace(status, state=State.STALE, reason="no observations"), None).level == STALE
