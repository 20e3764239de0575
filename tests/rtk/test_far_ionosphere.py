"""For how long slant ionospheres last, by the distance: waves of minutes beyond 10 km, an hour nearer by."""

from math import exp

import numpy as np
import pytest

from rtkmesh.gnss.signals import KEYS_PER_SATELLITE
from rtkmesh.rtk.acceptance import FAR_M
from rtkmesh.rtk.bookkeeping import Motion, advance
from rtkmesh.rtk.memory import new_memory
from rtkmesh.rtk.options import Mode, RtkOptions
from rtkmesh.rtk.relative import walks_of
from rtkmesh.rtk.setup import setup_of
from rtkmesh.rtk.state import DYNAMIC, HISTORY, SEED_MOVING, USUAL_M, Filter

MINUTES_S = 600.0
HOUR_S = 3600.0
START_M = 0.1
MOTION = Motion(3.0, 1.5, 5.0)


def carried_m(length_m: float, mode: Mode, step_s: float) -> tuple[float, float, float]:
    """Return what is left of an ionosphere of 10 cm, exactly known, after a step without observations; its sigma, and its usual size."""
    walks = walks_of(setup_of(RtkOptions(mode=mode, systems="G")), length_m, new_memory())
    keys, history = np.array([5, 5 * KEYS_PER_SATELLITE], np.int64), np.full((2, HISTORY), np.nan)
    history[0, USUAL_M] = walks.ionosphere_sigma_m
    f = Filter(np.zeros(DYNAMIC + 2), np.zeros((DYNAMIC + 2, DYNAMIC + 2)), keys, history)
    f.x[DYNAMIC] = START_M
    assert advance(f, step_s, False, MOTION, np.array((4e6, 0.0, 5e6)), walks, SEED_MOVING)
    return float(f.x[DYNAMIC]), float(np.sqrt(f.P[DYNAMIC, DYNAMIC])), walks.ionosphere_sigma_m


@pytest.mark.parametrize(
    ("length_m", "mode", "memory_s"),
    [
        (FAR_M - 1.0, Mode.KINEMATIC, HOUR_S),
        (FAR_M + 1.0, Mode.KINEMATIC, MINUTES_S),
        (5.0 * FAR_M, Mode.STATIC, MINUTES_S),
        (5.0 * FAR_M, Mode.MOVING_BASE, HOUR_S),
    ],
)
def test_it_goes_back_to_its_usual_size(length_m: float, mode: Mode, memory_s: float) -> None:
    """First-order Gauss-Markov (Gelb 1974, 2.2): exp(-t / T) of it is left, and 1 - exp(-2 t / T) of its usual variance has come."""
    for step_s in (30.0, 0.5 * memory_s, memory_s):
        left_m, sigma_m, usual_m = carried_m(length_m, mode, step_s)
        assert left_m == pytest.approx(START_M * exp(-step_s / memory_s))
        assert sigma_m == pytest.approx(usual_m * np.sqrt(1.0 - exp(-2.0 * step_s / memory_s)))
