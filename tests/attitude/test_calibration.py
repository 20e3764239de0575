"""Calibration of layouts: simulated truth recovered within its sigmas, moving and standing, wrong fixes, coloured noise, odd shapes."""

from dataclasses import replace
from math import isnan, radians

import numpy as np
import pytest

from rtkmesh.attitude.calibration import Calibration, Instant, calibrate
from rtkmesh.attitude.colour import correlation_factor
from rtkmesh.attitude.rigid_body import Measured, Shape, baselines
from rtkmesh.attitude.rotation import rotation_of_angles
from rtkmesh.errors import OptionError

NAMES = ("a", "b", "c", "d", "e")
TRUTH = np.array([[0.0, 0.0, 0.0], [0.8, 0.0, 0.0], [0.79, 0.8, 0.0], [-0.01, 0.78, 0.03], [0.4, 0.4, -0.25]])
SIGMAS_M = np.array([0.004, 0.004, 0.008])
MOVING, STANDING = True, False


def rotations(rng: np.random.Generator, count: int, *, moving: bool) -> list[np.ndarray]:
    if not moving:
        return [rotation_of_angles(2.0, 0.03, -0.04)] * count
    return [rotation_of_angles(*angles) for angles in rng.uniform([0.0, -0.1, -0.1], [6.2, 0.1, 0.1], (count, 3))]


def measured(rotation: np.ndarray, places: np.ndarray, error_m: np.ndarray, seen: list[int]) -> Measured:
    values = (places @ rotation.T + error_m)[seen] + [1000.0, -2000.0, 30.0]
    return Measured(np.eye(len(places))[seen], values, np.kron(np.eye(len(seen)), np.diag(SIGMAS_M**2)))


def simulated(seed: int, places: np.ndarray, count: int = 60, *, moving: bool = MOVING, rho: float = 0.0) -> list[Instant]:
    """Positions of all antennas with told sigmas, errors of a first-order Gauss-Markov process of correlation ``rho``."""
    rng = np.random.default_rng(seed)
    error, instants = rng.normal(0.0, SIGMAS_M, places.shape), list[Instant]()
    for i, rotation in enumerate(rotations(rng, count, moving=moving)):
        error = rho * error + np.sqrt(1.0 - rho**2) * rng.normal(0.0, SIGMAS_M, places.shape)
        instants.append(Instant(float(i), measured(rotation, places, error, list(range(len(places))))))
    return instants


def nees(found: Calibration, truth: np.ndarray) -> float:
    """Return the squared error by the covariance (pseudo-inverse: what is fixed by definition has no error)."""
    error = (found.layout.positions_m - truth).ravel()
    assert found.layout.cov_m2 is not None
    return float(error @ np.linalg.pinv(found.layout.cov_m2, rcond=1e-6, hermitian=True) @ error)


@pytest.mark.parametrize("moving", [MOVING, STANDING])
@pytest.mark.parametrize("antennas", [3, 4, 5])
def test_the_truth_is_found_within_its_sigmas(antennas: int, moving: bool):
    """Normalised squared errors are on average the number of free coordinates."""
    truth, free = TRUTH[:antennas], 3 * antennas - 6
    values = [nees(calibrate(NAMES[:antennas], simulated(seed, truth, moving=moving)), truth) for seed in range(14)]
    assert 0.6 * free < np.mean(values) < 1.5 * free


def test_correlated_errors_are_in_the_covariance():
    """Errors that stay alike for 20 instants: the sigmas grow with them, and stay honest to a factor of two in variance."""
    truth = TRUTH[:4]
    found = [calibrate(NAMES[:4], simulated(seed, truth, 300, moving=STANDING, rho=0.9)) for seed in range(10)]
    white = calibrate(NAMES[:4], simulated(0, truth, 300))
    assert np.mean([one.sigmas_m[3, 1] for one in found]) > 2.5 * white.sigmas_m[3, 1]
    assert 3.0 < np.mean([nees(one, truth) for one in found]) < 12.0
    assert np.mean([row.lag_one for one in found for row in one.distances]) == pytest.approx(0.9, abs=0.05)
    assert 8.0 < np.mean([row.correlation_s for one in found for row in one.distances]) < 25.0
    assert all(row.correlation_s < 4.0 for row in white.distances)


def test_wrong_fixes_do_not_reach_the_layout():
    """A fifth of the instants has one antenna off by decimetres, some have all: distances tell."""
    rng, truth = np.random.default_rng(3), TRUTH[:4]
    instants = simulated(3, truth, 200)
    for i in range(0, 200, 5):
        values = instants[i].measured.values_ned_m
        values[rng.integers(4)] += rng.choice([-1.0, 1.0], 3) * rng.uniform(0.15, 1.0, 3)
    found = calibrate(NAMES[:4], instants)
    assert np.abs(found.layout.positions_m - truth).max() < 0.004
    assert found.reduced + found.wrong_distance + found.wrong_chi_square >= 38
    assert nees(found, truth) < 20.0
    assert min(row.within_pct for row in found.distances) < 95.0


def test_sigmas_of_the_input_are_scaled_per_axis():
    """Told half of what they are horizontally, a third vertically."""
    told = np.outer(*[1.0 / np.tile([2.0, 2.0, 3.0], 4)] * 2)
    drawn = simulated(5, TRUTH[:4], 500)
    instants = [Instant(one.time_s, replace(one.measured, cov_m2=one.measured.cov_m2 * told)) for one in drawn]
    found = calibrate(NAMES[:4], instants)
    assert (found.scale_horizontal, found.scale_vertical) == pytest.approx((2.0, 3.0), rel=0.06)
    assert found.chi_square / found.degrees == pytest.approx(1.0, abs=0.05)


def test_antennas_need_not_all_be_there_at_once():
    """Instants of three of five, and baselines instead of positions, in one adjustment."""
    rng, instants = np.random.default_rng(8), list[Instant]()
    for i, rotation in enumerate(rotations(rng, 300, moving=MOVING)):
        error = rng.normal(0.0, SIGMAS_M, TRUTH.shape)
        seen = sorted(rng.choice(5, 4, replace=False).tolist())
        if i % 3:
            instants.append(Instant(float(i), measured(rotation, TRUTH, error, seen)))
            continue
        pairs = tuple((seen[0], k) for k in seen[1:])
        vectors = np.array([(TRUTH[k] - TRUTH[j]) @ rotation.T + error[k] - error[j] for j, k in pairs])
        joint = np.kron(np.eye(3) + np.ones((3, 3)), np.diag(SIGMAS_M**2))
        instants.append(Instant(float(i), baselines(pairs, 5, vectors, joint)))
    found = calibrate(NAMES, instants)
    assert nees(found, TRUTH) < 25.0
    assert found.layout.positions_m == pytest.approx(TRUTH, abs=0.004)
    assert 0.9 < found.chi_square / found.degrees < 1.1


def test_two_antennas_give_a_length():
    found = calibrate(NAMES[:2], simulated(1, TRUTH[:2], 200))
    assert found.shape is Shape.LINE
    assert found.layout.positions_m[1] == pytest.approx([0.8, 0.0, 0.0], abs=4.0 * found.sigmas_m[1, 0])
    assert 0.0002 < found.sigmas_m[1, 0] < 0.001
    assert "elevation" in found.notes[0]


def test_antennas_on_a_line_are_said_to_be():
    truth = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [-0.4, 0.0, 0.0]])
    found = calibrate(NAMES[:3], simulated(2, truth, 300))
    assert found.shape is Shape.LINE
    assert found.layout.positions_m == pytest.approx(truth, abs=0.003)
    assert any("on one line" in note for note in found.notes)


def test_flatness_and_axes():
    """Four of a plane: flat within its sigma; the fifth antenna is 25 cm above it, z points down; the centroid as origin."""
    flat = TRUTH[:4] * [1.0, 1.0, 0.0]
    found = calibrate(NAMES[:4], simulated(4, flat, 300))
    assert found.thickness_m < 4.0 * found.thickness_sigma_m
    raised = calibrate(NAMES, simulated(4, TRUTH, 300), centred=True)
    assert raised.layout.positions_m.mean(axis=0) == pytest.approx([0.0, 0.0, 0.0], abs=1e-12)
    assert raised.layout.positions_m[4, 2] - raised.layout.positions_m[0, 2] == pytest.approx(-0.25, abs=0.004)
    assert raised.thickness_m > 20.0 * raised.thickness_sigma_m
    assert isnan(calibrate(NAMES[:3], simulated(4, TRUTH[:3])).thickness_m)


def test_mean_tilt_and_mounting():
    found = calibrate(NAMES[:4], simulated(6, TRUTH[:4], 200, moving=STANDING))
    assert (found.mean_pitch_rad, found.mean_roll_rad) == pytest.approx((0.03, -0.04), abs=0.002)
    turned = found.mounted(rotation_of_angles(radians(90.0), 0.0, 0.0))
    assert turned.layout.positions_m[1] == pytest.approx([0.0, 0.8, 0.0], abs=0.002)
    assert turned.sigmas_m[1, 1] == pytest.approx(found.sigmas_m[1, 0])


def test_what_cannot_be_calibrated_is_said():
    with pytest.raises(OptionError, match="two antennas or more"):
        calibrate(("a",), [])
    with pytest.raises(OptionError, match="0 of 0 instants"):
        calibrate(("a", "b"), [])
    apart = [
        Instant(float(i), baselines(((i % 2 * 2, i % 2 * 2 + 1),), 4, np.array([[0.8, 0.0, 0.0]]), np.eye(3) * 1e-4)) for i in range(50)
    ]
    with pytest.raises(OptionError, match="nothing ties antenna c, d"):
        calibrate(NAMES[:4], apart)


def test_correlation_factors_are_those_of_closed_forms():
    """(1 + rho) / (1 - rho) of a first-order process."""
    rng = np.random.default_rng(0)
    values = np.zeros(40_000)
    for i, noise in enumerate(rng.normal(0.0, 1.0, len(values) - 1)):
        values[i + 1] = 0.8 * values[i] + noise
    assert correlation_factor(values) == pytest.approx(9.0, rel=0.15)
    assert correlation_factor(rng.normal(0.0, 1.0, 40_000)) == pytest.approx(1.0, abs=0.1)
