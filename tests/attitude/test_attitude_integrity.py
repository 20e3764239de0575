"""Detection, identification and exclusion of faults of antennas: the reference's table, and what cannot be told."""

from math import radians

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from tests.attitude.draws import compiled_only

from rtkmesh.attitude.chi_square import chi_square_limit
from rtkmesh.attitude.integrity import Finding, detection_power, distance_test, judged, noncentral_tail
from rtkmesh.attitude.rigid_body import Layout, baselines, fit, positions
from rtkmesh.attitude.rotation import rotation_of_angles
from rtkmesh.gnss.integrity import Integrity

SQUARE = Layout(("a", "b", "c", "d"), np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]]))
TRUTH = rotation_of_angles(radians(40.0), 0.0, 0.0)
ONE = np.diag([1e-4, 1e-4, 4e-4])
COV = np.kron(np.eye(4), ONE).astype(np.float64)
# North, east, down of antenna 1 in mm; what the reference found of 1 % false alarms: by perimeter, by distances, by the rigid fit.
TABLE = [
    ((50.0, 0.0, 0.0), 0.00, 0.56, 0.52),
    ((100.0, 0.0, 0.0), 0.00, 1.00, 1.00),
    ((35.36, 35.36, 0.0), 0.14, 0.70, 0.66),
    ((0.0, 0.0, 100.0), 0.01, 0.01, 0.17),
    ((0.0, 0.0, 200.0), 0.09, 0.11, 0.94),
]


def draws(fault_mm: tuple[float, float, float], count: int, seed: int = 4) -> NDArray[np.float64]:
    """Return measured positions (count, 4, 3) with a fault on the first antenna."""
    clean = SQUARE.positions_m @ TRUTH.T
    clean[0] += np.array(fault_mm) * 1e-3
    return np.random.default_rng(seed).multivariate_normal(clean.ravel(), COV, count).reshape(-1, 4, 3)


@pytest.mark.parametrize(("fault_mm", "perimeter", "distances", "rigid"), TABLE)
def test_the_published_detection_table_is_met(fault_mm: tuple[float, float, float], perimeter: float, distances: float, rigid: float):
    """By formula for the rigid fit, by draws for distances; the paper's perimeter is blind to all but the largest."""
    fault = np.zeros((4, 3))
    fault[0] = np.array(fault_mm) * 1e-3
    assert detection_power(SQUARE, COV, fault, TRUTH, 0.01) == pytest.approx(rigid, abs=0.05)
    found = [distance_test(SQUARE, draw, COV) for draw in draws(fault_mm, 500)]
    assert {degrees for _, degrees in found} == {5}, "the sixth degree, the twist, changes no distance"
    assert np.mean([value > chi_square_limit(0.01, 5) for value, _ in found]) == pytest.approx(distances, abs=0.07)
    around = [(0, 1), (1, 3), (3, 2), (2, 0)]
    sums = np.array([sum(np.linalg.norm(draw[i] - draw[j]) for i, j in around) for draw in draws(fault_mm, 500)])
    assert np.mean(np.abs(sums - 4.0) > 0.081) == pytest.approx(perimeter, abs=0.06)


@compiled_only
def test_power_is_that_of_draws():
    """The formula against fits."""
    fault = np.zeros((4, 3))
    fault[0, 0] = 0.06
    fits = [fit(SQUARE, positions(draw, COV)) for draw in draws((60.0, 0.0, 0.0), 800)]
    rate = np.mean([f.chi_square > chi_square_limit(0.01, 6) for f in fits if f is not None])
    assert detection_power(SQUARE, COV, fault, TRUTH, 0.01) == pytest.approx(rate, abs=0.05)


@compiled_only
def test_faults_are_identified_or_said_not_to_be():
    """A clear horizontal fault is excluded and the right antenna; a vertical one of a plane cannot be told and is not guessed."""
    clear = [judged(SQUARE, positions(draw, COV)) for draw in draws((120.0, 0.0, 0.0), 120)]
    assert np.mean([j.excluded == ("a",) for j in clear]) > 0.9
    assert not [j.excluded for j in clear if j.excluded not in {("a",), ()}], "no wrong antenna"
    vertical = [judged(SQUARE, positions(draw, COV)) for draw in draws((0.0, 0.0, 300.0), 120)]
    assert {j.excluded for j in vertical} <= {(), ("a",)}, "only where the plane's tilt tells"
    open_ = [j for j in vertical if j.finding is Finding.NOT_IDENTIFIABLE]
    assert len(open_) > 30
    assert {j.integrity for j in open_} == {Integrity.FAILED}
    assert all("a" in j.suspects for j in open_)


@compiled_only
def test_what_follows_an_exclusion_is_honest():
    """The attitude without the antenna is within the sigmas that are said for it."""
    errors: list[float] = []
    for draw in draws((150.0, 150.0, 0.0), 200):
        j = judged(SQUARE, positions(draw, COV))
        if j.finding is Finding.EXCLUDED and j.fit is not None:
            heading = (j.fit.angles_rad[0] - radians(40.0) + np.pi) % (2.0 * np.pi) - np.pi
            errors.append(heading**2 / j.fit.angles_cov_rad2[0, 0])
            assert j.fit.degrees == 3
    assert len(errors) > 195
    assert 0.75 < np.mean(errors) < 1.3


@compiled_only
def test_false_alarms_are_as_configured():
    """One in a hundred when one in a hundred is asked for."""
    clean = [judged(SQUARE, positions(draw, COV), false_alarm=0.01).finding is not Finding.OK for draw in draws((0.0, 0.0, 0.0), 1500)]
    assert 0.004 < np.mean(clean) < 0.018


def test_less_redundancy_is_said():
    """Three antennas detect and do not identify; two know their length; with an unknown turn there is none; one has no attitude."""
    three = SQUARE.only(("a", "b", "c"))
    bad = three.positions_m.copy()
    bad[0, 0] += 0.3
    verdict = judged(three, positions(bad, COV[:9, :9]))
    assert (verdict.finding, verdict.integrity) == (Finding.NOT_IDENTIFIABLE, Integrity.FAILED)
    two = SQUARE.only(("a", "b"))
    measured = baselines(((0, 1),), 2, np.array([[1.3, 0.0, 0.0]]), 1e-4 * np.eye(3))
    assert judged(two, measured).finding is Finding.NOT_IDENTIFIABLE
    assert judged(two, baselines(((0, 1),), 2, np.array([[1.01, 0.0, 0.0]]), 1e-4 * np.eye(3))).finding is Finding.OK
    one = Layout(("a",), np.zeros((1, 3)))
    assert judged(one, positions(np.zeros((1, 3)), 1e-4 * np.eye(3))).integrity is Integrity.UNAVAILABLE


def test_five_antennas_of_space_find_two_faults():
    """A raised fifth antenna makes a vertical fault identifiable, and two faults can be told."""
    places = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0.5, 0.5, -0.8], [0.2, 0.9, -0.6]])
    layout = Layout(tuple("abcdef"), places)
    bad = places.copy()
    bad[0, 2] += 0.4
    cov = np.kron(np.eye(6), ONE).astype(np.float64)
    assert judged(layout, positions(bad, cov)).excluded == ("a",)
    bad[3, 0] += 0.5
    assert judged(layout, positions(bad, cov)).excluded == ("a", "d")


@given(st.floats(0.1, 40.0), st.integers(1, 12), st.floats(0.0, 60.0))
def test_noncentral_tail_is_a_probability_that_grows_with_the_fault(value: float, degrees: int, noncentrality: float):
    low, high = noncentral_tail(value, degrees, noncentrality), noncentral_tail(value, degrees, noncentrality + 1.0)
    assert 0.0 <= low <= high + 1e-9 <= 1.0 + 1e-9


def test_noncentral_tail_of_the_tables():
    """Chi-square of 6 degrees, noncentrality 10, above 16.8119: by draws 0.467."""
    rng = np.random.default_rng(1)
    sample = rng.standard_normal((200_000, 6))
    sample[:, 0] += 10.0**0.5
    assert noncentral_tail(16.8119, 6, 10.0) == pytest.approx(np.count_nonzero((sample**2).sum(axis=1) > 16.8119) / len(sample), abs=0.004)
