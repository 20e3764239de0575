"""The plumb line of a vehicle that moves: closed forms, and its sigma against accelerations that come and go."""

from math import radians

import numpy as np
import pytest

from rtkmesh.attitude.filter import AttitudeFilter
from rtkmesh.attitude.filter_options import FilterOptions, Outcome
from rtkmesh.attitude.plumb_line import GRAVITY_MPS2, PLUMB, ForceWindows, gravity_force, tilt_sigma_rad
from rtkmesh.attitude.rotation import rotation_of_angles
from rtkmesh.gnss.time import GpsTime

START = GpsTime(2400, 604_799.8)  # the week turns over within the first window


def test_a_window_is_a_mean_at_its_middle() -> None:
    windows = ForceWindows()
    found = [windows.take(START + 0.1 * k, np.array([float(k), 0.0, -9.8])) for k in range(6)]
    assert found[:5] == [None] * 5
    assert found[5] is not None
    assert found[5].mean_mps2 == pytest.approx([2.5, 0.0, -9.8])
    assert found[5].time - START == pytest.approx(0.25, abs=1e-6)
    assert found[5].end - found[5].start == pytest.approx(0.5, abs=1e-6)


def test_a_gap_and_a_step_back_begin_another_window() -> None:
    windows = ForceWindows()
    times = [0.0, 0.1, 0.2, 0.9, 1.0, 1.1, 1.2, 1.3, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0]
    found = [windows.take(START + t, np.zeros(3)) for t in times]
    assert [k for k, window in enumerate(found) if window] == [13]


@pytest.mark.parametrize("angles_deg", [(0.0, 0.0, 0.0), (200.0, 10.0, -20.0)])
def test_an_acceleration_is_left_out(angles_deg: tuple[float, float, float]) -> None:
    rotation, acceleration = rotation_of_angles(*map(radians, angles_deg)), np.array([1.0, -2.0, 0.5])
    force = rotation.T @ (acceleration - np.array([0.0, 0.0, GRAVITY_MPS2]))
    assert gravity_force(force, acceleration, rotation) == pytest.approx(rotation.T @ np.array([0.0, 0.0, -GRAVITY_MPS2]), abs=1e-12)


def test_accelerations_that_last_do_not_average_down() -> None:
    """A first-order process of 3 s: the sigma that many windows leave is that of the error of their mean, drawn."""
    rng, tau_s, sigma, dt = np.random.default_rng(1), 3.0, 0.5, 0.5
    rho, n = np.exp(-dt / tau_s), 60
    means = []
    for _ in range(400):
        a = np.empty(n)
        a[0] = sigma * rng.standard_normal()
        for k in range(1, n):
            a[k] = rho * a[k - 1] + sigma * np.sqrt(1.0 - rho**2) * rng.standard_normal()
        means.append(a.mean() / GRAVITY_MPS2)
    assert tilt_sigma_rad(1e-6, sigma, dt) / np.sqrt(n) == pytest.approx(np.std(means), rel=0.1)
    assert tilt_sigma_rad(0.0, sigma, 1e6) == pytest.approx(sigma / GRAVITY_MPS2)


def test_a_plumb_line_never_overrules_and_never_speaks_for_a_filter() -> None:
    """A vehicle that rests is told another roll a hundred times by a force of the right size; a heading that is persistently other wins."""
    attitude = AttitudeFilter(FilterOptions(rate_walk_radps_rts=0.01))
    for k in range(50):
        attitude.heading(START + 0.1 * k, 1.0, radians(0.3))
        attitude.tilt(START + 0.1 * k, np.array([0.0, 0.0, -9.81]), radians(1.0), PLUMB)
    tilted = np.array([0.0, 9.81 * np.sin(1.0), -9.81 * np.cos(1.0)])
    outcomes = [attitude.tilt(START + 5.0 + 0.01 * k, tilted, radians(1.0), PLUMB).outcome for k in range(100)]
    assert set(outcomes) == {Outcome.GATED}
    later = []
    for k in range(12):
        later.append(attitude.heading(START + 6.0 + 0.1 * k, 2.5, radians(0.3)).outcome)
        attitude.tilt(START + 6.0 + 0.1 * k, np.array([0.0, 0.0, -9.81]), radians(3.0), PLUMB)
    assert Outcome.RESET in later
