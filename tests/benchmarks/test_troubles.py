"""The scan over troubles: what is drawn happens to the run and not to its twin, and what must never be is found."""

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rtkmesh.gnss.epoch import HALF_CYCLE, SLIP
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.options import RtkOptions
from rtkmesh.rtk.solution import Solution, Status
from rtkmesh.simulation.sky import absolute_s

pytestmark = pytest.mark.slow  # without compiled kernels

NAMES = ("troubles", "modes", "scan", "simulated", "campaign")


@pytest.fixture
def run_with(benchmarks: SimpleNamespace) -> Any:
    """Simulate an open run of a minute at 1 Hz with one trouble."""

    def simulated(factor: str, level: str, **changes: Any) -> Any:
        setup = replace(benchmarks.simulated.Setup(seconds=60, options=RtkOptions()), **changes)
        return benchmarks.simulated.simulate(
            benchmarks.troubles.TROUBLES[factor][level](setup, np.random.default_rng(4)), np.random.default_rng(5)
        )

    return simulated


def _sent(benchmarks: SimpleNamespace, run: Any, source: str) -> list[GpsTime]:
    """Return the tags of the epochs of a stream in the order in which they reach the session."""

    class Told:
        def __init__(self) -> None:
            self.tags: list[GpsTime] = []

        def feed(self, stream: str, message: Any, *_: float) -> None:
            if stream == source and hasattr(message, "pseudorange_m"):
                self.tags.append(message.time)

    told = Told()
    for _, event in sorted(benchmarks.simulated._events(run, told), key=lambda timed: timed[0]):
        if event is not None:
            event()
    return told.tags


def test_all_levels_are_drawn(benchmarks: SimpleNamespace):
    """Two thousand runs have every level of every trouble, one to three of them each, and configurations of modes.py."""
    troubles = benchmarks.troubles
    drawn = [troubles.levels_of_run(3, run) for run in range(2000)]
    assert {factor: {levels[factor] for levels in drawn} for factor in troubles.SCAN.levels} == troubles.SCAN.levels
    assert {sum(levels[factor] != troubles.NONE for factor in troubles.TROUBLES) for levels in drawn} == {1, 2, 3}
    assert drawn[7] | benchmarks.modes.levels_of_run(3, 7) == drawn[7]


def test_a_twin_has_no_trouble_and_is_else_the_same(benchmarks: SimpleNamespace):
    """A run with bad codes observes at the same place and time as its twin, and differs from it in these codes alone."""
    scan, troubles = benchmarks.scan, benchmarks.troubles
    none = {factor: frozenset((troubles.NONE,)) for factor in troubles.TROUBLES}
    run = next(scan.picked(troubles.SCAN, 1, none | {"codes": frozenset(("step",)), "rate": frozenset(("1",))}))
    simulated, twin = scan.simulated_run(troubles.SCAN, 1, run), benchmarks.simulated.simulate(*troubles.twin_of_run(1, run))
    assert twin.disturbances == []
    bad = {d.satellite for _, d in simulated.disturbances}
    assert len(bad) == 1
    for mine, clean in zip(simulated.rover_epochs, twin.rover_epochs, strict=True):
        np.testing.assert_array_equal(mine.phase_cyc, clean.phase_cyc)
        assert set(mine.satellite[mine.pseudorange_m != clean.pseudorange_m]) <= bad


@pytest.mark.parametrize(
    ("level", "jumps"), [("rover's jumps", (True, False)), ("base's jumps", (False, True)), ("both jump", (True, True))]
)
def test_clocks_jump_within_the_run(run_with: Any, level: str, jumps: tuple[bool, bool]):
    """Codes and phases jump by a millisecond once, all together."""
    run = run_with("clocks", level)
    for observed, has_jump in zip((run.rover, run.base), jumps, strict=True):
        assert sum(o.clock_reset for o in observed) == int(has_jump)
        steps_m = [np.median(b.epoch.pseudorange_m) - np.median(a.epoch.pseudorange_m) for a, b in pairwise(observed)]
        assert (np.abs(steps_m).max() > 250e3) == has_jump


def test_a_rover_that_restarts_is_silent_and_comes_back_cold(benchmarks: SimpleNamespace, run_with: Any):
    """No epoch comes while it is dead, and none is a chance; phases begin anew."""
    run = run_with("rover", "restart")
    at, gap = run.setup.rover_restart_at, run.setup.restart_gap
    tags = _sent(benchmarks, run, "rover")
    dead = {run.start + float(k) for k in range(at, at + gap)}
    assert dead.isdisjoint(tags)
    assert len(tags) == 60 - gap
    assert all(len(run.rover_epochs[k]) == 0 for k in range(at, at + gap))
    assert run.rover[59].epoch.lock_s.max() < 60 - at - gap


def test_epochs_arrive_as_drawn(benchmarks: SimpleNamespace, run_with: Any):
    """Swapped ones before those that they follow, repeated ones again, thinned and late ones so."""
    first = _sent(benchmarks, run_with("rover", "epochs swapped"), "rover")[:4]
    assert [b - a for a, b in pairwise(first)] == [-1.0, 3.0, -1.0]
    assert len(_sent(benchmarks, run_with("rover", "epochs twice"), "rover")) == 179
    thinned = _sent(benchmarks, run_with("link", "thinned"), "base")
    assert len({b - a for a, b in pairwise(thinned)}) == 1
    assert 2 <= thinned[1] - thinned[0] <= 10
    assert 50 <= len(_sent(benchmarks, run_with("link", "late"), "base")) <= 58


def test_phases_slip_as_drawn(run_with: Any):
    """Told slips are told, half cycles stay unresolved for seconds, those that flip are off by halves that nobody tells."""
    told = run_with("phases", "told slips")
    assert sum(int((epoch.flags & SLIP > 0).sum()) for epoch in told.rover_epochs) > 20
    assert (run_with("phases", "half cycles unresolved").rover_epochs[8].flags & HALF_CYCLE > 0).any()
    flips = [d for _, d in run_with("phases", "half cycles flip").disturbances]
    assert flips
    assert all(d.phase_cyc % 0.5 == 0.0 and d.phase_cyc != 0.0 for d in flips)


def test_a_rover_that_stands_first_moves_then(run_with: Any):
    """It is where it was until then, and gone after it."""
    run = run_with("start", "stands first")
    stands = int(run.setup.stands_s)
    moved_m = np.linalg.norm(run.baseline_ecef_m - run.baseline_ecef_m[0], axis=1)
    assert moved_m[stands] < 1e-6
    assert moved_m[-1] > 1.0


def test_ephemerides_come_as_drawn(benchmarks: SimpleNamespace, run_with: Any):
    """Late ones within half a minute, new ones after they are sent, the end of a week in the middle of the run."""

    def sent(run: Any) -> list[tuple[float, Any]]:
        return [(at, e) for at, e in benchmarks.simulated._navigation(run) if hasattr(e, "satellite")]

    late = sent(run_with("navigation", "late"))
    assert 20.0 < max(at for at, _ in late) < 30.0
    changing = run_with("navigation", "new issues")
    assert all(at >= e.transmitted - changing.start for at, e in sent(changing))
    assert any(0.0 < e.transmitted - changing.start < 60.0 for _, e in sent(changing))
    weeks = [epoch.time.week for epoch in run_with("navigation", "end of week").rover_epochs]
    assert weeks.count(min(weeks)) == weeks.count(max(weeks)) == 30
    assert {e.health for _, e in sent(run_with("navigation", "unhealthy"))} == {0, 1}


def test_what_must_never_be_is_found(benchmarks: SimpleNamespace):
    """Times that fall, positions that are none, covariances that are negative."""
    good = Solution(GpsTime(2445, 1.0), Status.SINGLE, position_ecef_m=np.ones(3), position_cov_ecef_m2=np.eye(3))
    assert list(benchmarks.scan.oddities([good, replace(good, time=GpsTime(2445, 2.0))])) == []
    assert list(benchmarks.scan.oddities([good, good])) == ["1 times do not rise"]
    nowhere, negative = replace(good, position_ecef_m=np.full(3, np.nan)), replace(good, position_cov_ecef_m2=-np.eye(3))
    assert list(benchmarks.scan.oddities([nowhere])) == ["values that are none in 1 epochs, first at 1.0 s of the week"]
    assert list(benchmarks.scan.oddities([negative])) == ["covariances that are none in 1 epochs, first at 1.0 s of the week"]
    assert list(benchmarks.scan.oddities([replace(good, status=Status.FIX)])) == [
        "values that are none in 1 epochs, first at 1.0 s of the week"
    ]


def test_an_exception_is_told_with_its_command(benchmarks: SimpleNamespace, monkeypatch: pytest.MonkeyPatch):
    """The run counts as odd, without fixes."""
    scan, troubles = benchmarks.scan, benchmarks.troubles

    def fail(_run: Any) -> Any:
        raise ZeroDivisionError("no way")

    monkeypatch.setattr(scan, "solutions_of", fail)
    run = next(scan.picked(troubles.SCAN, 1, {"rate": frozenset(("1",))}))
    found = scan.measure(troubles.SCAN, 1, run)
    assert next(scan.odd_runs(troubles.SCAN, [found])).startswith(f"ZeroDivisionError: no way: troubles.py --run 1:{run} --trace")
    assert found.outcome.fixes == 0


def test_a_run_without_fixes_is_held_against_its_twin(benchmarks: SimpleNamespace):
    """It counts as one that never has one, and is listed."""
    scan, troubles = benchmarks.scan, benchmarks.troubles

    def outcome(status: int) -> Any:
        judged = benchmarks.simulated.Judged(np.full(10, status), np.zeros((10, 3)), np.ones(10), np.ones(10, np.bool_), np.zeros(10))
        return benchmarks.campaign.outcome("1:0", 0, judged)

    levels = troubles.levels_of_run(1, 0) | {"ambiguities": "continuous"}
    worse, same = scan.Measured(0, levels, outcome(2), (), outcome(1)), scan.Measured(0, levels, outcome(1), (), outcome(1))
    assert scan.row_of([worse, same])["never"] == 1
    assert scan.row_of([worse, same])["twin_right_pct"] == 100.0
    assert [line.partition(": ")[0] for line in scan.losses(troubles.SCAN, [worse, same])] == ["  0.0 % right, 100.0 of the twin"]


def test_a_twin_with_wrong_fixes_is_told(benchmarks: SimpleNamespace, capsys: pytest.CaptureFixture[str]):
    """It has a command of its own, that shows the run without its troubles."""
    scan, troubles = benchmarks.scan, benchmarks.troubles
    judged = benchmarks.simulated.Judged(np.ones(10, np.int64), np.ones((10, 3)), np.ones(10), np.ones(10, np.bool_), np.zeros(10))
    wrong = benchmarks.campaign.outcome("1:0", 0, judged)
    assert list(scan.wrong_twins(troubles.SCAN, [scan.Measured(0, troubles.levels_of_run(1, 0), wrong)])) == []
    told = next(scan.wrong_twins(troubles.SCAN, [scan.Measured(0, troubles.levels_of_run(1, 0), wrong, (), wrong)]))
    assert told.startswith("  10 wrong of   10,  10.0 s, worst   1.73 m: troubles.py --run 1:0 --twin --trace ")
    run = next(scan.picked(troubles.SCAN, 1, {"codes": frozenset(("step",)), "rate": frozenset(("1",))}))
    for twin, faults in ((False, 1), (True, 0)):
        scan._one(troubles.SCAN, f"1:{run}", traced=True, twin=twin)
        assert capsys.readouterr().out.count("fault of the rover") == faults


def test_a_twin_ends_before_what_a_run_crosses(benchmarks: SimpleNamespace):
    """The end of the week is in the middle of the run, its twin is a minute before it."""
    scan, troubles = benchmarks.scan, benchmarks.troubles
    run = next(scan.picked(troubles.SCAN, 1, {"navigation": frozenset(("end of week",)), "rate": frozenset(("1",))}))
    simulated, twin = scan.simulated_run(troubles.SCAN, 1, run), benchmarks.simulated.simulate(*troubles.twin_of_run(1, run))
    assert absolute_s(GpsTime(simulated.start.week + 1, 0.0)) - absolute_s(simulated.start) == 30.0
    assert simulated.start - twin.start == 60.0
