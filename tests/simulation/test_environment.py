"""Atmosphere and visibility of the simulation."""

from math import pi

import numpy as np
import pytest

from rtkmesh.simulation.environment import Atmosphere, Window, hidden_below_rad

AZIMUTH = np.linspace(0.0, 6.0, 40)
ELEVATION = np.linspace(0.15, 1.5, 40)


def ionosphere(place: tuple[float, float], time_s: float, seed: int = 1) -> np.ndarray:
    atmosphere = Atmosphere(seed)
    return atmosphere.ionosphere_l1_m(atmosphere.waves(np.array((*place, 0.0)), time_s), AZIMUTH, ELEVATION)


def test_a_kilometre_of_baseline_sees_about_a_millimetre():
    """Slant L1 delays 1 km apart differ by at most 4 ppm, typically by a few tenths of one."""
    worst = [np.abs(ionosphere((1000.0, 0.0), 60.0 * k) - ionosphere((0.0, 0.0), 60.0 * k)) for k in range(60)]
    assert 1e-4 < np.median(worst) < 2e-3
    assert np.max(worst) < 4e-3


def test_processes_agree_on_the_atmosphere_and_seeds_do_not():
    """The same seed gives the same, another seed another."""
    assert np.array_equal(ionosphere((10.0, 20.0), 5.0), ionosphere((10.0, 20.0), 5.0))
    assert not np.allclose(ionosphere((0.0, 0.0), 5.0), ionosphere((0.0, 0.0), 5.0, seed=2))
    assert Atmosphere(3).zenith_wet_m(np.zeros(3), 9.0) == Atmosphere(3).zenith_wet_m(np.zeros(3), 9.0)


def test_zenith_delay_differs_by_centimetres_from_the_standard_and_hardly_within_a_site():
    """Over many days the sigma is about 2 cm; over 1 km at most 1 mm."""
    values = [Atmosphere(seed).zenith_wet_m(np.zeros(3), 0.0) for seed in range(200)]
    assert 0.01 < np.std(values) < 0.04
    near = [Atmosphere(seed).zenith_wet_m(np.array((700.0, 700.0, 0.0)), 0.0) for seed in range(200)]
    assert np.abs(np.subtract(near, values)).max() < 1e-3


def test_windows_repeat_and_the_strictest_holds():
    """A total outage wins over a partial one; outside of both the sky is open."""
    windows = (Window(100.0, 10.0, 20.0, pi), Window(50.0, 15.0, 30.0, 0.6))
    found = [hidden_below_rad(windows, t) for t in (5.0, 12.0, 20.0, 40.0, 62.0, 70.0, 111.0)]
    assert found == pytest.approx([-pi / 2, pi, pi, 0.6, -pi / 2, 0.6, pi])
