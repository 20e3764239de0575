"""Motion and attitude of the simulated vehicles."""

from collections.abc import Callable
from itertools import pairwise
from math import atan2, pi

import numpy as np
import pytest

from rtkmesh.simulation.scenario import SCENARIOS
from rtkmesh.simulation.trajectories import AntennaPath, Pose, Site, boat, driving, enu_from_body, static

SITE = Site(0.9, 0.2, 50.0)
ALL = pytest.mark.parametrize("trajectory", [static, driving, boat])


def angle(difference_rad: float) -> float:
    return (difference_rad + pi) % (2.0 * pi) - pi


@ALL
def test_motion_is_smooth(trajectory: Callable[[float], Pose]):
    """No jump of position or attitude in ten minutes: at most 20 m/s and 60 degrees/s."""
    poses = [trajectory(0.05 * k) for k in range(12001)]
    steps = np.diff([p.position_enu_m for p in poses], axis=0)
    turns = [[angle(b.heading_rad - a.heading_rad), b.pitch_rad - a.pitch_rad, b.roll_rad - a.roll_rad] for a, b in pairwise(poses)]
    assert np.linalg.norm(steps, axis=1).max() < 20.0 * 0.05
    assert np.abs(turns).max() < np.deg2rad(60.0) * 0.05


def test_driving_heads_where_it_goes_between_standstill_and_15_mps():
    """The nose points along the velocity whenever there is one."""
    speeds: list[float] = []
    for time_s in np.arange(0.0, 300.0, 0.5):
        velocity = np.subtract(driving(time_s + 0.01).position_enu_m, driving(time_s - 0.01).position_enu_m) / 0.02
        speeds.append(float(np.hypot(*velocity[:2])))
        if speeds[-1] > 1.0:
            assert abs(angle(atan2(velocity[0], velocity[1]) - driving(time_s).heading_rad)) < 1e-3
    assert min(speeds) < 0.05
    assert 13.0 < max(speeds) < 16.0


def test_driving_turns_once_around_on_the_spot():
    """Between the loops the vehicle stands and turns by 360 degrees."""
    times = np.arange(240.05, 299.95, 0.1)
    turned = sum(angle(driving(t + 0.1).heading_rad - driving(t).heading_rad) for t in times)
    assert turned == pytest.approx(2.0 * pi, abs=0.01)
    assert np.ptp([driving(t).position_enu_m[:2] for t in times], axis=0).max() < 1e-9


def test_body_axes_follow_the_aerospace_convention():
    """Heading east: forward is east, right is south; nose up lifts the front, right side down lowers the right."""
    level = enu_from_body(Pose((0.0, 0.0, 0.0), heading_rad=pi / 2.0))
    assert level[:, 0] == pytest.approx([1.0, 0.0, 0.0], abs=1e-12)
    assert level[:, 1] == pytest.approx([0.0, -1.0, 0.0], abs=1e-12)
    assert level[:, 2] == pytest.approx([0.0, 0.0, -1.0], abs=1e-12)
    assert enu_from_body(Pose((0.0, 0.0, 0.0), pitch_rad=0.1))[2, 0] == pytest.approx(np.sin(0.1))
    assert enu_from_body(Pose((0.0, 0.0, 0.0), roll_rad=0.1))[2, 1] == pytest.approx(-np.sin(0.1))


@ALL
def test_attitude_is_a_rotation(trajectory: Callable[[float], Pose]):
    """Orthonormal and right-handed: forward, right, down."""
    turn = enu_from_body(trajectory(77.3))
    assert turn @ turn.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1.0)


@ALL
def test_the_baseline_of_two_antennas_shows_the_attitude(trajectory: Callable[[float], Pose]):
    """From a rear to a front antenna: constant length, azimuth is heading, elevation is pitch."""
    rear, front = AntennaPath(SITE, trajectory, (-0.3, 0.2, -1.5)), AntennaPath(SITE, trajectory, (0.7, 0.2, -1.5))
    for time_s in (0.0, 33.3, 251.7, 290.1):
        east, north, up = front.offset_enu_m(time_s) - rear.offset_enu_m(time_s)
        pose = trajectory(time_s)
        assert np.linalg.norm(front.position_ecef_m(time_s) - rear.position_ecef_m(time_s)) == pytest.approx(1.0, abs=1e-8)
        assert angle(atan2(east, north) - pose.heading_rad) == pytest.approx(0.0, abs=1e-12)
        assert np.arcsin(up) == pytest.approx(pose.pitch_rad, abs=1e-9)


@ALL
def test_velocity_integrates_to_the_way(trajectory: Callable[[float], Pose]):
    """Simpson's rule over a second gives back the displacement."""
    path = AntennaPath(SITE, trajectory, (1.0, 0.5, -2.0))
    times = np.linspace(40.0, 41.0, 41)
    velocities = np.array([path.velocity_ecef_mps(t) for t in times])
    weights = np.array([1.0, *([4.0, 2.0] * 20)[:-1], 1.0]) / 120.0
    assert weights @ velocities == pytest.approx(path.position_ecef_m(41.0) - path.position_ecef_m(40.0), abs=2e-6)


def test_demo_antennas_are_about_a_metre_apart_and_the_base_half_a_kilometre_away():
    """What the brief of the demo says."""
    demo = SCENARIOS["demo"]
    rover, heading, base = (np.array(demo.antennas[name].offset_m) for name in ("rover", "heading", "base"))
    assert 0.9 <= np.linalg.norm(heading - rover) <= 1.2
    assert 400.0 < np.linalg.norm(base) < 600.0
