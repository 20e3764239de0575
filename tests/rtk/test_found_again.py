"""A rover that stands is found again where it was, when nothing was seen for a while."""

from dataclasses import replace
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rtkmesh.rtk.options import Mode, RtkOptions
from rtkmesh.simulation import classes, trajectories
from rtkmesh.simulation.receiver import ReceiverOptions

pytestmark = pytest.mark.slow  # without compiled kernels

NAMES = ("simulated",)
HIDDEN, SEEN = 40, 46  # seconds from and to which nothing is seen
ELSEWHERE_ENU_M = (-180.0, 20.0, 3.0)
M8_OF_GPS = replace(classes.M8, systems="G")


@pytest.fixture(scope="module")
def simulated(benchmarks: SimpleNamespace) -> ModuleType:
    """The module that simulates and judges runs."""
    return benchmarks.simulated


def hidden(simulated: ModuleType, seed: int, rover: ReceiverOptions, **changes: Any) -> Any:
    """Return a run of a minute of a receiver that stands under an open sky, all of which is hidden for six seconds."""
    options = RtkOptions(mode=Mode.STATIC, frequencies=rover.frequencies, systems=rover.systems)
    outages = (simulated.Outage(float(HIDDEN), float(SEEN - HIDDEN)),)
    setup = simulated.Setup(seconds=60, options=options, trajectory=trajectories.static, rover=rover, outages=outages)
    return simulated.simulate(replace(setup, **changes), np.random.default_rng(seed))


@pytest.mark.parametrize("seed", [5, 8, 9])
def test_where_it_was_a_rover_that_stands_is_found_at_once(simulated: ModuleType, seed: int):
    """It has right fixes as soon as its phases are tracked again; without its last fix it has none in the rest of the run."""
    run = hidden(simulated, seed, M8_OF_GPS)
    found = simulated.judge(run, simulated.solve(run))
    assert found.fixed[:HIDDEN].any()
    assert found.fixed[SEEN + 6 :].all()
    assert not found.wrong.any()


def test_a_base_that_was_carried_elsewhere_meanwhile_has_another_baseline(simulated: ModuleType):
    """The last fix says nothing of it, and does not stand in the way of new ones."""
    run, other = hidden(simulated, 1, classes.F9P), hidden(simulated, 1, classes.F9P, base_enu_m=ELSEWHERE_ENU_M)
    at, shift_m = HIDDEN + 2, tuple(np.subtract(ELSEWHERE_ENU_M, run.setup.base_enu_m).tolist())
    carried = replace(
        run,
        setup=replace(run.setup, shift_at=at, shift_enu_m=shift_m),
        base_epochs=[*run.base_epochs[:at], *other.base_epochs[at:]],
        baseline_ecef_m=np.concatenate([run.baseline_ecef_m[:at], other.baseline_ecef_m[at:]]),
    )
    found = simulated.judge(carried, simulated.solve(carried))
    assert found.fixed[:HIDDEN].all()
    assert found.fixed[SEEN + 5 :].all()
    assert not found.wrong.any()
