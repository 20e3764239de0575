"""Protection levels of attitude: closed forms, refits without each antenna, and how often injected faults leave them."""

from math import asin, cos, inf, log, nan, radians, sin, sqrt

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from tests.attitude.draws import compiled_only

from rtkmesh.attitude.design import Noise, design
from rtkmesh.attitude.integrity import Finding, judged
from rtkmesh.attitude.joint import Edge, joint, rotation_covariance
from rtkmesh.attitude.protection import INFLATION, Guarding, Told, baseline_levels, fault_priors, levels, widening
from rtkmesh.attitude.rigid_body import Fit, Layout, Measured, fit, positions
from rtkmesh.attitude.rotation import angles_per_error, rotation_of_angles, vector_of, wrapped

SQUARE = Layout(("a", "b", "c", "d"), np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]]))
TRIANGLE = SQUARE.only(("a", "b", "c"))
PAIR = SQUARE.only(("a", "b"))
ANGLES = (radians(40.0), radians(3.0), radians(-5.0))
TRUTH = rotation_of_angles(*ANGLES)
NOISE = Noise(0.01, 0.02)
UNSEEN = radians(10.0)


def drawn(layout: Layout, rng: np.random.Generator, fault_m: NDArray[np.float64] | None = None) -> Measured:
    """Return noisy positions of the antennas; a fault (n, 3) is added."""
    n = len(layout.names)
    cov = NOISE.cov_m2(n)
    places = rng.multivariate_normal((layout.positions_m @ TRUTH.T).ravel(), cov).reshape(n, 3)
    return positions(places if fault_m is None else places + fault_m, cov)


def one_fault(layout: Layout, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return a fault of 3 to 30 cm of one antenna, mostly in height, where it is found late."""
    fault = np.zeros((len(layout.names), 3))
    fault[rng.integers(len(layout.names))] = 10.0 ** rng.uniform(-1.5, -0.5) * rng.normal(0.0, [0.2, 0.2, 1.0])
    return fault


def off_rad(found: Fit) -> NDArray[np.float64]:
    return np.abs([wrapped(angle - true) for angle, true in zip(found.angles_rad, ANGLES, strict=True)])


def test_without_noise_levels_are_sigmas_of_the_design():
    """Level and north, nothing separates: the larger of the sigmas with all antennas and without each, at their shares of the risk."""
    measured = positions(SQUARE.positions_m, NOISE.cov_m2(4))
    guarding = Guarding(risk=1e-5, antenna_fault=3e-4)
    found = levels(SQUARE, measured, judged(SQUARE, measured), guarding)
    planned = design(SQUARE, NOISE, np.zeros(3))
    own, other = sqrt(2.0 * log(1.0 / 0.5e-5)), sqrt(2.0 * log(3e-4 / (0.5e-5 / 4)))
    for value, name in zip(found.rad, ("heading_rad", "pitch_rad", "roll_rad"), strict=True):
        worst = max(getattr(one, name) for one in planned.without.values())
        assert value == pytest.approx(INFLATION * max(own * getattr(planned.whole, name), other * worst), rel=1e-6)
    assert not found.open


@pytest.mark.parametrize(("layout", "gone"), [(SQUARE, 1), (SQUARE, 3), (TRIANGLE, 0), (TRIANGLE, 2)])
def test_the_attitude_without_an_antenna_is_that_of_a_fit_without_it(layout: Layout, gone: int):
    """To first order; of three antennas two are left, and the turn about them is as level as the body."""
    measured = drawn(layout, np.random.default_rng(3))
    verdict = judged(layout, measured)
    other = fit(layout, measured.without(gone))
    assert verdict.fit is not None
    assert other is not None
    priors = np.zeros(len(layout.names))
    priors[gone] = 1.0
    found = levels(layout, measured, verdict, Guarding(risk=1e-3, unseen_sigma_rad=UNSEEN), priors)
    turn = angles_per_error(verdict.fit.ned_from_body)
    apart = np.abs(turn @ vector_of(other.ned_from_body @ verdict.fit.ned_from_body.T))
    tilt = rotation_covariance(other, UNSEEN) - other.cov[:3, :3]
    sigmas = np.sqrt(np.diag(turn @ (INFLATION**2 * other.cov[:3, :3] + tilt) @ turn.T))
    np.testing.assert_allclose(found.rad, apart + widening(1.0, 0.5e-3 / len(layout.names)) * sigmas, rtol=0.02)


@pytest.mark.parametrize("layout", [SQUARE, TRIANGLE])
@compiled_only
def test_injected_faults_stay_within_the_levels(layout: Layout, monkeypatch: pytest.MonkeyPatch):
    """Faults in every epoch, and sigmas that are exact and not inflated: of what passes the tests a good part is beyond 3.4 sigmas,
    and no larger share beyond its levels than each hypothesis may have.
    """
    monkeypatch.setattr("rtkmesh.attitude.protection.INFLATION", 1.0)
    rng, guarding = np.random.default_rng(11), Guarding(risk=0.16, antenna_fault=1.0, unseen_sigma_rad=UNSEEN)
    given, by_sigma, by_level = 0, 0, 0
    for _ in range(300):
        measured = drawn(layout, rng, one_fault(layout, rng))
        verdict = judged(layout, measured)
        if verdict.fit is None or verdict.finding not in (Finding.OK, Finding.EXCLUDED):
            continue
        given += 1
        error = off_rad(verdict.fit)
        by_sigma += bool(np.any(error > 3.4 * np.sqrt(np.diag(verdict.fit.angles_cov_rad2))))
        by_level += bool(np.any(error > levels(layout, measured, verdict, guarding).rad))
    assert given > 150
    assert by_sigma > 0.1 * given
    assert by_level < 3 * 0.08 / len(layout.names) * given, "three angles"


@compiled_only
def test_levels_of_a_wrong_exclusion_reach_to_the_truth(monkeypatch: pytest.MonkeyPatch):
    """When another antenna explains the misfit nearly as well as the one that was left out, the level covers that, too."""
    monkeypatch.setattr("rtkmesh.attitude.integrity._CLEARLY_WORSE", 1.0)
    rng, wrong = np.random.default_rng(5), 0
    for _ in range(150):
        fault = np.zeros((4, 3))
        fault[0, 2] = 0.25
        measured = drawn(SQUARE, rng, fault)
        verdict = judged(SQUARE, measured)
        if verdict.finding is Finding.EXCLUDED and verdict.fit is not None:
            found = levels(SQUARE, measured, verdict, Guarding(unseen_sigma_rad=UNSEEN))
            wrong += verdict.excluded != ("a",)
            assert (off_rad(verdict.fit) < found.rad).all()
            assert not {*found.open} & {*verdict.excluded}
    assert wrong > 2


def test_what_nothing_bounds_is_infinite_and_what_is_not_seen_is_not_a_number():
    """Two antennas test their distance only: a fault across the line is heading. With a risk beyond the fault's own the noise is left."""
    measured = positions(PAIR.positions_m, NOISE.cov_m2(2))
    verdict = judged(PAIR, measured)
    found = levels(PAIR, measured, verdict, Guarding(unseen_sigma_rad=UNSEEN))
    assert (found.rad[0], found.rad[1], np.isnan(found.rad[2])) == (inf, inf, True)
    assert found.open == ("a", "b")
    loose = levels(PAIR, measured, verdict, Guarding(risk=1e-2, antenna_fault=1e-3, unseen_sigma_rad=UNSEEN))
    assert loose.rad[0] == pytest.approx(INFLATION * widening(1.0, 5e-3) * sqrt(2.0) * 0.01, rel=1e-6)
    assert not loose.open
    alone = SQUARE.only(("a",))
    none = positions(alone.positions_m, NOISE.cov_m2(1))
    assert np.isnan(levels(alone, none, judged(alone, none), Guarding()).rad).all()


def test_an_attitude_that_failed_is_bounded_by_every_suspect():
    """A vertical fault of four in a plane that cannot be told whose it is: the level reaches from each explanation to what is said."""
    fault = np.zeros((4, 3))
    fault[2, 2] = 0.3
    measured = positions(SQUARE.positions_m @ TRUTH.T + fault, NOISE.cov_m2(4))
    verdict = judged(SQUARE, measured)
    assert verdict.finding is Finding.NOT_IDENTIFIABLE
    assert verdict.fit is not None
    assert (off_rad(verdict.fit) < levels(SQUARE, measured, verdict, Guarding(unseen_sigma_rad=UNSEEN)).rad).all()


def test_two_faults_at_once_count_where_they_are_likely():
    """Integers that are wrong with a tenth each: two antennas of four may be at fault together, and two that are left see no turn."""
    measured = drawn(SQUARE, np.random.default_rng(6))
    verdict = judged(SQUARE, measured)
    rare, likely = (levels(SQUARE, measured, verdict, Guarding(), np.full(4, prior)) for prior in (1e-4, 0.1))
    assert max(np.degrees(rare.rad)) < 15.0 < 30.0 < min(np.degrees(likely.rad[1:]))
    pair = np.array([1.0, 1.0, 0.0, 0.0])
    hidden = np.zeros((4, 3))
    hidden[:2, 2] = 0.5, -0.5
    wrong = drawn(SQUARE, np.random.default_rng(6), hidden)
    said = judged(SQUARE, wrong, false_alarm=1e-300)
    assert said.fit is not None
    assert (off_rad(said.fit) < levels(SQUARE, wrong, said, Guarding(unseen_sigma_rad=UNSEEN), pair).rad).all()


def test_levels_grow_as_the_risk_shrinks():
    measured = drawn(SQUARE, np.random.default_rng(1))
    verdict = judged(SQUARE, measured)
    found = np.array([levels(SQUARE, measured, verdict, Guarding(risk=risk)).rad for risk in (1e-2, 1e-4, 1e-6, 1e-8)])
    assert (np.diff(found, axis=0) > 0.0).all()


def test_baselines_of_one_antenna_share_its_fault():
    """A fault of the antenna that all baselines start from is a hypothesis like any other: what is between the others stays."""
    edges = [Edge("a", name, TRUTH @ SQUARE.positions_m[k], 1e-4 * np.eye(3)) for k, name in enumerate("abcd") if k]
    shifted = [Edge(e.start, e.end, e.vector_ned_m + np.array([0.0, 0.0, 0.055]), e.cov_m2) for e in edges]
    measured = joint(SQUARE, shifted)
    verdict = judged(SQUARE, measured)
    assert verdict.fit is not None
    assert verdict.finding is Finding.OK, "it has not been found"
    found = levels(SQUARE, measured, verdict, Guarding(unseen_sigma_rad=UNSEEN))
    assert (off_rad(verdict.fit) > 3.4 * np.sqrt(np.diag(verdict.fit.angles_cov_rad2))).any()
    assert (off_rad(verdict.fit) < found.rad).all()


def test_wrong_integers_are_faults_of_the_antenna_they_lead_to():
    edges = [Edge("a", "b", np.ones(3), np.eye(3), wrong=0.1), Edge("base", "c", np.ones(3), np.eye(3), wrong=2.0)]
    np.testing.assert_allclose(fault_priors(SQUARE, edges, 1e-4), [1e-4, 0.1001, 1.0, 1e-4])


@pytest.mark.parametrize("size_m", [0.6, 1.0, 2.0])
def test_a_large_fault_that_is_told_leaves_what_the_others_bound(size_m: float):
    """Vertical, of four in a plane: only the true lengths tell whose it is, and no linear term may say otherwise."""
    fault = np.zeros((4, 3))
    fault[3, 2] = size_m
    rng = np.random.default_rng(2)
    verdict = judged(SQUARE, measured := drawn(SQUARE, rng, fault))
    assert verdict.excluded == ("d",)
    three = drawn(TRIANGLE, np.random.default_rng(2))
    found = levels(SQUARE, measured, verdict, Guarding()).rad
    np.testing.assert_allclose(found, levels(TRIANGLE, three, judged(TRIANGLE, three), Guarding()).rad, rtol=0.25)


def test_two_antennas_are_bounded_by_the_levels_of_their_baseline():
    """Level and along the nose: the angle that a level of the baseline is seen under; longer than the baseline it bounds nothing."""
    north, straight = np.array([2.0, 0.0, 0.0]), np.eye(3)
    found = baseline_levels(straight, np.array([1.0, 0.0, 0.0]), Told(north, 0.2, 0.5), Guarding(unseen_sigma_rad=0.0))
    assert found[:2] == pytest.approx([asin(0.1), asin(0.25)])
    assert baseline_levels(straight, np.array([1.0, 0.0, 0.0]), Told(north, 2.1, nan), Guarding()).tolist()[:2] == [inf, inf]
    beside = baseline_levels(straight, np.array([cos(0.01), sin(0.01), 0.0]), Told(north, 0.2, 0.5), Guarding(unseen_sigma_rad=0.0))
    assert beside[0] == pytest.approx(asin(0.1) + 0.01, rel=1e-3)


@settings(max_examples=200, deadline=None)
@given(
    angles=st.tuples(st.floats(0.0, 6.28), st.floats(-0.5, 0.5), st.floats(-0.3, 0.3)),
    place=st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(-0.3, 0.3)).filter(lambda p: np.hypot(p[0], p[1]) > 0.5),
    horizontal_m=st.floats(0.001, 0.1), vertical_m=st.floats(0.001, 0.1), azimuth=st.floats(0.0, 6.28), share=st.floats(-1.0, 1.0),
)  # fmt: skip
def test_whatever_is_within_the_levels_of_a_baseline_is_within_those_of_the_angles(
    angles: tuple[float, float, float],
    place: tuple[float, float, float],
    horizontal_m: float,
    vertical_m: float,
    azimuth: float,
    share: float,
):
    """The worst of a baseline within its levels: of a body that turns no more about the line than the tilt that is not seen."""
    layout = Layout(("a", "b"), np.array([[0.0, 0.0, 0.0], place]))
    true = rotation_of_angles(*angles) @ np.array(place)
    off = np.array([horizontal_m * cos(azimuth), horizontal_m * sin(azimuth), share * vertical_m])
    guarding = Guarding(unseen_sigma_rad=0.0)
    [found, right] = [
        fit(layout, joint(layout, [Edge("a", "b", v, 1e-4 * np.eye(3))]), rotation_of_angles(*angles)) for v in (true + off, true)
    ]
    assert found is not None
    assert right is not None
    assert found.unseen_ned is not None
    bound = baseline_levels(found.ned_from_body, found.unseen_ned, Told(true + off, horizontal_m, vertical_m), guarding)
    errors = np.array([abs(wrapped(x - y)) for x, y in zip(found.angles_rad, right.angles_rad, strict=True)])
    assert np.all(errors <= bound * 1.1 + 2.0 * errors.max() ** 2)  # first order
