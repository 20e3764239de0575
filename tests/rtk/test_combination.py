"""Two runs made into one: what is believed, what is refused, and that no covariance claims more than is known."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtkmesh.gnss.integrity import Integrity
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.combination import ANCHORS, EQUAL_M, HINDSIGHT, How, combine_runs
from rtkmesh.rtk.fusion import Estimate, fuse, misfit
from rtkmesh.rtk.solution import IntegrityReason, Reason, Solution, Status
from rtkmesh.rtk.track import ROW, solutions_of, track_of

BASE = np.array((4.0e6, 5.0e5, 4.9e6))
PLACE = np.array((100.0, -50.0, 20.0))
FIXED_M, FLOAT_M = 0.01, 0.3
FORWARD_OF = {How.FORWARD: How.BACKWARD, How.FORWARD_FIX: How.BACKWARD_FIX, How.FORWARD_CHOSEN: How.BACKWARD_CHOSEN}
SWAPPED = {**FORWARD_OF, **{b: f for f, b in FORWARD_OF.items()}}


def solution(k, kind, offset_m=0.0, *, grade=3, velocity_mps=0.0):
    """Return the solution of epoch k: "fix", "float", "dgps", "single" or "none", off by so many metres along x."""
    status = Status[kind.upper()]
    if status in (Status.NONE, Status.SINGLE):
        place = BASE + PLACE if status is Status.SINGLE else np.full(3, np.nan)
        return Solution(time=GpsTime(2400, 100.0 + k), status=status, position_ecef_m=place, position_cov_ecef_m2=9.0 * np.eye(3))
    baseline = PLACE + np.array((offset_m, 0.0, 0.0))
    P = np.eye(3) * (FIXED_M if status is Status.FIX else FLOAT_M) ** 2
    return Solution(
        time=GpsTime(2400, 100.0 + k), status=status, position_ecef_m=BASE + baseline, position_cov_ecef_m2=P, base_ecef_m=BASE,
        baseline_ecef_m=baseline, baseline_cov_ecef_m2=P.copy(), velocity_ecef_mps=np.full(3, velocity_mps),
        velocity_cov_ecef_m2ps2=np.eye(3) * 0.05**2, acceleration_ecef_mps2=np.zeros(3), grade=grade if status is Status.FIX else 0,
        ambiguities_fixed=10 if status is Status.FIX else 0, age_s=0.5,
    )  # fmt: skip


def combined(forward, backward):
    """Combine two lists of (kind, offset) or kinds; return the solutions and How per epoch."""
    runs = [[solution(k, *(one if isinstance(one, tuple) else (one,))) for k, one in enumerate(run)] for run in (forward, backward)]
    result = combine_runs(*(track_of(run).table for run in runs))
    return list(solutions_of(result.table)), [How(how) for how in result.how]


def errors_m(solutions):
    return np.array([np.linalg.norm(s.position_ecef_m - BASE - PLACE) for s in solutions])


def sigmas_m(solutions):
    return np.array([np.sqrt(np.trace(s.position_cov_ecef_m2) / 3.0) for s in solutions])


def test_a_track_keeps_every_field():
    """All that a solution says but its satellites comes back to the last bit."""
    first = replace(solution(3, "fix", 0.1), ratio=7.5, reason=Reason.RATIO, satellites_rover=12, resets=2, waited_s=0.25)
    (second,) = solutions_of(track_of([first]).table)
    for name in ROW.names or ():
        if name not in ("week", "tow_s", "arc_s"):
            one, other = getattr(first, name), getattr(second, name)
            assert one == other if isinstance(one, Integrity) else np.array_equal(one, other, equal_nan=True), name
    assert first.time == second.time


def test_agreement_confirms_but_makes_no_sigma_smaller():
    """Both fixed on the same integers: FIX, and the covariance is that of one, for both are made of the same phases."""
    solutions, how = combined(["fix"] * 8, [("fix", 0.004)] * 8)
    assert how == [How.AGREED] * 8
    assert all(s.status is Status.FIX and s.grade == 3 for s in solutions)
    assert sigmas_m(solutions) == pytest.approx(FIXED_M)


def test_a_fix_of_one_direction_is_taken_where_the_other_float_does_not_contradict():
    """The first epochs, which the forward run had only as float solutions, are fixed by the backward run."""
    solutions, how = combined(["float"] * 5 + ["fix"] * 20, ["fix"] * 25)
    assert how[:5] == [How.BACKWARD_FIX] * 5
    assert all(s.status is Status.FIX for s in solutions)


def test_a_fix_that_the_other_float_contradicts_is_refused():
    """Nothing supports it, and the float is metres off beyond its sigmas: the float stands."""
    solutions, how = combined([("fix", 3.0)] * 10, ["float"] * 10)
    assert how == [How.REFUSED] * 10
    assert all(s.status is Status.FLOAT and s.reason is Reason.VALIDATION and s.grade == 0 and s.ambiguities_fixed == 0 for s in solutions)
    assert errors_m(solutions).max() < FLOAT_M


def test_integers_that_both_have_found_outweigh_a_float():
    """The same stretch agrees elsewhere: a float that contradicts it is what codes in trees do."""
    solutions, how = combined(["fix"] * 20, ["fix"] * 12 + [("float", 3.0)] * 8)
    assert how[12 : 20 - 0] == [How.FORWARD_FIX] * 8
    assert errors_m(solutions).max() < 0.01


def test_a_dispute_is_decided_by_who_kept_his_integers():
    """The forward stretch agrees before and after, the backward run began anew in between: the forward fixes stand."""
    wrong = ("fix", 0.4)
    backward = ["fix"] * 10 + ["float"] + [wrong] * 6 + ["float"] + ["fix"] * 10
    solutions, how = combined(["fix"] * len(backward), backward)
    assert how[11:17] == [How.FORWARD_CHOSEN] * 6
    assert all(s.status is Status.FIX for s in solutions[11:17])
    assert errors_m(solutions).max() < 0.01


def test_an_undecided_dispute_is_no_fix_and_its_covariance_covers_both():
    """Two runs fixed half a metre apart, nothing to choose by: FLOAT, within two sigmas of either."""
    solutions, how = combined(["fix"] * 10, [("fix", 0.5)] * 10)
    assert how == [How.REFUSED] * 10
    assert all(s.status is Status.FLOAT and s.reason is Reason.VALIDATION for s in solutions)
    for s in solutions:
        for offset in (0.0, 0.5):
            d = (s.position_ecef_m - BASE - PLACE - np.array((offset, 0.0, 0.0)))[None]
            assert misfit(d, s.position_cov_ecef_m2[None])[0] < 4.0


def test_hindsight_refuses_the_last_fixes_before_the_integers_were_lost():
    """Nobody else is fixed there, and what broke the stretch may have begun before."""
    _, how = combined(["fix"] * 10 + ["float"] * 10, ["float"] * 20)
    assert how[: 10 - HINDSIGHT] == [How.FORWARD_FIX] * (10 - HINDSIGHT)
    assert how[10 - HINDSIGHT : 10] == [How.REFUSED] * HINDSIGHT


def test_a_young_fix_that_nobody_supports_is_refused():
    """Grade 1 says that no search has confirmed it since it was accepted."""
    forward = [solution(k, "fix", grade=1) for k in range(8)]
    backward = [solution(k, "float") for k in range(8)]
    assert set(combine_runs(track_of(forward).table, track_of(backward).table).how.tolist()) == {How.REFUSED}


def test_what_is_made_of_both_has_no_levels_and_what_stands_keeps_its_own():
    """Protection levels and the probability of a fix are those of the run that stands; of a fusion nothing is said."""
    said = {"fix_probability": 0.999, "protection_horizontal_m": 0.05, "integrity": Integrity.OK, "integrity_reason": IntegrityReason.OK}
    run = [replace(solution(0, "float"), protection_horizontal_m=3.0), replace(solution(1, "fix"), **said)]
    made, stood = solutions_of(combine_runs(track_of(run).table, track_of(run).table).table)
    assert (made.integrity, made.integrity_reason, made.fix_probability) == (Integrity.UNAVAILABLE, IntegrityReason.NOT_WATCHED, 0.0)
    assert np.isnan(made.protection_horizontal_m)
    assert {name: getattr(stood, name) for name in said} == said


def test_old_float_solutions_become_better_and_young_ones_claim_nothing():
    """Arcs of hours in both directions are independent; arcs of seconds saw the same multipath; codes alone are the epoch's own."""
    runs = [track_of([solution(k, "float", offset) for k in range(4)]).table for offset in (0.1, -0.1)]
    for arc_s, factor in ((1e5, np.sqrt(0.5)), (5.0, 1.0), (np.nan, 1.0)):
        for table in runs:
            table["arc_s"] = arc_s
        result = combine_runs(*runs)
        assert (result.how == How.SMOOTHED).all()
        sigma = np.sqrt(np.trace(result.table["position_cov_ecef_m2"], axis1=1, axis2=2) / 3.0)
        assert sigma == pytest.approx(FLOAT_M * factor, rel=0.01)


def test_float_solutions_that_contradict_each_other_say_so():
    """Sigmas that cannot be right grow until they are."""
    runs = [track_of([solution(0, "float", offset)]).table for offset in (0.0, 3.0)]
    for table in runs:
        table["arc_s"] = 1e5
    (s,) = solutions_of(combine_runs(*runs).table)
    assert sigmas_m([s])[0] > 0.8


def test_velocities_are_met_in_the_middle():
    """One run lags, the other leads; both know the epoch's Dopplers, so no sigma shrinks."""
    forward = track_of([solution(k, "fix", velocity_mps=1.0) for k in range(3)])
    backward = track_of([solution(k, "fix", velocity_mps=1.2) for k in range(3)])
    for s in solutions_of(combine_runs(forward.table, backward.table).table):
        assert s.velocity_ecef_mps == pytest.approx(1.1, abs=0.1001)
        assert np.sqrt(np.diag(s.velocity_cov_ecef_m2ps2)) == pytest.approx(0.05)


def test_the_better_kind_of_solution_is_taken_and_singles_are_alike():
    """Float over codes, codes over single, anything over nothing."""
    _, how = combined(["float", "dgps", "single", "none", "single", "dgps"], ["dgps", "float", "none", "none", "single", "single"])
    assert how == [How.FORWARD, How.BACKWARD, How.FORWARD, How.NONE, How.ALIKE, How.FORWARD]


def test_runs_over_other_epochs_are_refused():
    """A fault of the caller."""
    with pytest.raises(ValueError, match="same epochs"):
        combine_runs(track_of([solution(0, "fix")]).table, track_of([solution(1, "fix")]).table)


kinds = st.sampled_from(["fix", "fix", "fix", "float", "float", "dgps", "single", "none"])
runs = st.lists(st.tuples(kinds, st.sampled_from([0.0, 0.003, 0.2, 2.0])), min_size=1, max_size=30)


@given(st.data())
def test_time_has_no_preferred_direction(data):
    """The mirrored runs give the mirrored result, with the directions exchanged."""
    forward = data.draw(runs)
    backward = data.draw(st.lists(st.tuples(kinds, st.sampled_from([0.001, 0.05, 0.3])), min_size=len(forward), max_size=len(forward)))
    there, how = combined(forward, backward)
    back, mirrored = combined(backward[::-1], forward[::-1])
    assert [SWAPPED.get(h, h) for h in mirrored[::-1]] == how
    assert [s.status for s in back[::-1]] == [s.status for s in there]
    assert sigmas_m(back[::-1]) == pytest.approx(sigmas_m(there), nan_ok=True)


@given(st.data())
def test_no_fix_appears_that_neither_run_had(data):
    """A combined fix is within EQUAL_M of a run's fix, or between two; covariances are symmetric and positive definite."""
    forward = data.draw(runs)
    backward = data.draw(st.lists(st.tuples(kinds, st.sampled_from([0.0, 0.1, 1.0])), min_size=len(forward), max_size=len(forward)))
    solutions, _ = combined(forward, backward)
    for s, one, other in zip(solutions, forward, backward, strict=True):
        if s.status is Status.FIX:
            offsets = [offset for kind, offset in (one, other) if kind == "fix"]
            place = (s.position_ecef_m - BASE - PLACE)[0]
            assert min(offsets) - EQUAL_M <= place <= max(offsets) + EQUAL_M
        if s.status is not Status.NONE:
            assert np.array_equal(s.position_cov_ecef_m2, s.position_cov_ecef_m2.T)
            assert np.linalg.eigvalsh(s.position_cov_ecef_m2)[0] > 0.0


def random_covariance(rng):
    A = rng.normal(size=(3, 3))
    return A @ A.T + 0.1 * np.eye(3)


@settings(max_examples=50)
@given(st.integers(0, 10_000), st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_a_fused_covariance_is_honest_whatever_the_shared_parts_have_in_common(seed, shared_a, shared_b):
    """The true covariance of the fused error, with shared parts as alike as they can be, is not larger than what is claimed."""
    rng = np.random.default_rng(seed)
    Pa, Pb = random_covariance(rng), random_covariance(rng)
    _, claimed = fuse(Estimate(np.zeros((1, 3)), Pa[None], np.array([shared_a])), Estimate(np.ones((1, 3)), Pb[None], np.array([shared_b])))
    moved = [
        fuse(
            Estimate(np.eye(3), np.repeat(Pa[None], 3, 0), np.full(3, shared_a)),
            Estimate(np.zeros((3, 3)), np.repeat(Pb[None], 3, 0), np.full(3, shared_b)),
        )[0]
    ]
    gain = moved[0].T  # what the fused vector takes from the first
    rest = np.eye(3) - gain
    cross = np.sqrt(shared_a * shared_b) * np.linalg.cholesky(Pa) @ np.linalg.cholesky(Pb).T
    for sign in (-1.0, 0.0, 1.0):
        C = sign * cross
        true = gain @ Pa @ gain.T + rest @ Pb @ rest.T + gain @ C @ rest.T + rest @ C.T @ gain.T
        assert np.linalg.eigvalsh(claimed[0] - true)[0] > -1e-9
    assert ANCHORS >= 1
