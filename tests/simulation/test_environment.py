"""Atmosphere and visibility of the simulation."""

from math import pi

import numpy as np
import pytest

from rtkmesh.simulation.environment import Atmosphere, Window, hidden_below_rad

AZIMUTH = np.linspace(0.0, 6.0, 40)
ELEVATION = np.linspace(0.15, 1.5, 40)


def ionosphere(place: tuple[float, float], time_s: float, seed: int = 1, slope_ppm: float = 0.0) -> np.ndarray:
    return Atmosphere(seed, slope_ppm=slope_ppm).ionosphere_l1_m(np.array((*place, 0.0)), time_s, AZIMUTH, ELEVATION)


def test_a_kilometre_of_baseline_sees_about_a_millimetre():
    """Slant L1 delays 1 km apart differ by at most 4 ppm, typically by a few tenths of one."""
    worst = [np.abs(ionosphere((1000.0, 0.0), 60.0 * k) - ionosphere((0.0, 0.0), 60.0 * k)) for k in range(60)]
    assert 1e-4 < np.median(worst) < 2e-3
    assert np.max(worst) < 4e-3


def test_a_slope_lasts_for_hours():
    """High in the sky it is as large as its sigma says over many days, and five minutes change it by a tenth at most."""
    here, there = (0.0, 0.0), (1e5, 0.0)

    def apart_ppm(seed: int, time_s: float) -> float:
        with_slope, without = (ionosphere(there, time_s, seed, s)[-1] - ionosphere(here, time_s, seed, s)[-1] for s in (0.5, 0.0))
        return float(with_slope - without) / 0.1

    found = np.array([[apart_ppm(seed, time_s) for time_s in (0.0, 300.0)] for seed in range(300)])
    assert 0.25 < np.sqrt(np.mean(found**2)) < 0.45  # 0.5, of which a sine in time leaves 0.7
    assert np.sqrt(np.mean((found[:, 1] - found[:, 0]) ** 2)) < 0.1 * np.sqrt(np.mean(found**2))


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
