"""The scan over configurations: what is drawn is what is simulated and solved, and what is wrong is found by its factors."""

from itertools import islice
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rtkmesh.rtk.options import AmbiguityMode, Mode

NAMES = ("modes", "scan", "simulated", "campaign")


def _outcome(benchmarks: SimpleNamespace, run: int, wrong: int) -> Any:
    """Return the outcome of a run of ten epochs at 1 Hz that all are fixes, so many of them wrong."""
    error = np.zeros((10, 3))
    error[:wrong, 0] = 1.0
    judged = benchmarks.simulated.Judged(np.ones(10, np.int64), error, np.ones(10), np.ones(10, np.bool_), np.zeros(10))
    return benchmarks.campaign.outcome(f"1:{run}", run, judged)


@pytest.fixture
def found(benchmarks: SimpleNamespace) -> list[Any]:
    """Two hundred drawn runs, of which those between antennas of a vehicle at 5 Hz are wrong for three epochs."""

    def is_bad(levels: dict[str, str]) -> bool:
        return levels["mode"] == "moving-base 2 m" and levels["rate"] == "5"

    drawn = [(run, benchmarks.modes.levels_of_run(1, run)) for run in range(200)]
    return [benchmarks.scan.Measured(run, levels, _outcome(benchmarks, run, 3 if is_bad(levels) else 0)) for run, levels in drawn]


def test_all_levels_are_drawn(benchmarks: SimpleNamespace):
    """A thousand runs have every level of every factor, and none that is not told."""
    modes = benchmarks.modes
    drawn = [modes.levels_of_run(3, run) for run in range(1000)]
    assert {factor: {levels[factor] for levels in drawn} for factor in modes.SCAN.levels} == modes.SCAN.levels


def test_only_picks_runs_of_the_same_numbers(benchmarks: SimpleNamespace):
    """What is asked for is left of the runs that there are; a run is the same whether it was asked for or not."""
    modes, scan = benchmarks.modes, benchmarks.scan
    only = scan.only_of(modes.SCAN, "mode=moving-base 2 m|static,systems=G")
    numbers: list[int] = list(islice(scan.picked(modes.SCAN, 2, only), 5))
    fitting = [k for k in range(numbers[-1] + 1) if (c := modes.configuration_of(2, k)).systems == "G" and c.mode in only["mode"]]
    assert numbers == fitting
    with pytest.raises(ValueError, match="no level Q"):
        scan.only_of(modes.SCAN, "systems=G|Q")
    with pytest.raises(ValueError, match="no factor 'system'"):
        scan.only_of(modes.SCAN, "system=G")


@pytest.mark.parametrize("mode", ["kinematic", "moving-base 2 m", "moving-base 20 m", "static", "static-start"])
def test_setups_are_what_was_drawn(benchmarks: SimpleNamespace, mode: str):
    """Rates, systems and bands are those of the configuration; antennas of a vehicle are as far apart as the mode says, others as drawn."""
    modes, scan = benchmarks.modes, benchmarks.scan
    only = {"mode": frozenset((mode,)), "ambiguities": frozenset(("fix-and-hold",)), "rate": frozenset(("5",))}
    run = next(scan.picked(modes.SCAN, 5, only))
    c, simulated = modes.configuration_of(5, run), scan.simulated_run(modes.SCAN, 5, run)
    setup = simulated.setup
    assert (setup.rate_hz, len(simulated.rover)) == (5, 200)
    assert (setup.options.systems, setup.options.frequencies) == (c.systems, int(c.frequencies))
    assert setup.options.ambiguity.mode is AmbiguityMode.FIX_AND_HOLD
    assert setup.options.mode is Mode("moving-base" if mode.startswith("moving-base") else mode)
    lengths_m = np.linalg.norm(simulated.baseline_ecef_m, axis=1)
    low_m, high_m = {"2 m": (1.99, 2.01), "20 m": (19.9, 20.1), "10 km": (8.8e3, 11.2e3)}.get(c.distance, (40.0, 5.3e3))
    assert low_m < lengths_m.min() <= lengths_m.max() < high_m
    if mode == "static":
        assert np.ptp(simulated.baseline_ecef_m, axis=0).max() < 1e-6


def test_a_cluster_is_found(benchmarks: SimpleNamespace, found: list[Any]):
    """The pair of levels that makes runs wrong comes first, with all of its runs wrong; each has a command; other levels have none."""
    modes, scan = benchmarks.modes, benchmarks.scan
    name, row = next(iter(scan.by_pairs(modes.SCAN, found).items()))
    assert name == "mode moving-base 2 m, rate 5"
    assert row["runs_with_wrong_pct"] == 100.0
    assert scan.row_of([m for m in found if m.levels["rate"] == "1"])["wrong_fixes"] == 0
    bad = [m for m in found if m.outcome.wrong]
    commands: list[str] = list(scan.replays(modes.SCAN, found))
    assert len(commands) == len(bad) > 2
    assert f"modes.py --run 1:{bad[0].run} --trace" in commands[0]


def test_runs_without_integers_count_for_the_last_column_alone(benchmarks: SimpleNamespace, found: list[Any]):
    """Their epochs are no chances for a fix."""
    scan = benchmarks.scan
    off = [m for m in found if m.levels["ambiguities"] == "off"]
    row = scan.row_of(found)
    assert row["runs"] == len(found) - len(off) < len(found)
    assert "runs" not in scan.row_of(off)


def test_an_easy_run_is_right(benchmarks: SimpleNamespace):
    """All systems on two bands, a survey receiver: fixes from the first epoch on, none wrong; the table has a line of it."""
    modes, scan = benchmarks.modes, benchmarks.scan
    levels = "mode=kinematic,systems=GREC,frequencies=2,rate=1,receiver=SURVEY,ambiguities=continuous,distance=50 m to 500 m"
    run = next(scan.picked(modes.SCAN, 1, scan.only_of(modes.SCAN, levels)))
    found = scan.measure(modes.SCAN, 1, run)
    assert (found.outcome.fixes, found.outcome.wrong, found.outcome.first_right_s, found.odd) == (40, 0, 0.0, ())
    assert "| easy | 1 | 40 | 100.0 | 100.0 | 0 |" in scan.page(modes.SCAN, {"easy": scan.row_of([found])})
