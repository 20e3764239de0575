"""What an engine learns of the noise takes as many seconds at every rate."""

from math import nan

import numpy as np
import pytest

from rtkmesh.rtk.around import FULL_STEP_S, Past
from rtkmesh.rtk.code_places import PLACE_SQUARES
from rtkmesh.rtk.memory import new_memory
from rtkmesh.rtk.noise import DOF, PHASE, SQUARES, learn_codes, learn_phases, new_code_scale
from rtkmesh.rtk.walk import no_walk

TRIAL = np.array([[6.0, 2.0, 0.0, 3.0, 0.0, 0.0, 0.0], [9.0, 4.0, 0.0, 5.0, 0.0, 0.0, 0.0]])


def new_past() -> Past:
    return Past(new_memory(), np.full(7, nan), new_code_scale(), new_code_scale(), no_walk())


def teach(past: Past, step_s: float, epochs: int) -> None:
    """Let a past learn the same of so many epochs, of both filters."""
    trial = TRIAL[:, : past.scale.shape[1]]
    for _ in range(epochs):
        before = past.learned(step_s)
        learn_codes(past.scale, trial)
        learn_codes(past.informed_scale, 2.0 * trial)
        learn_phases(past.scale, 30.0, 20.0)
        past.count_in_part(before, step_s)


@pytest.mark.parametrize("rate", [2, 5, 10, 20])
def test_epochs_of_a_second_teach_as_much_as_one(rate: int):
    """Before memories are full the sums are those of a single epoch, however many there were in its time."""
    one, many = new_past(), new_past()
    teach(one, FULL_STEP_S, 4)
    teach(many, FULL_STEP_S / rate, 4 * rate)
    assert np.allclose(many.scale, one.scale, rtol=1e-12)
    assert np.allclose(many.informed_scale, one.informed_scale, rtol=1e-12)


@pytest.mark.parametrize("rate", [5, 20])
def test_full_memories_forget_by_the_second(rate: int):
    """From noise of one size to that of another: what is left of the first after so many seconds is alike at every rate."""
    ratios = list[float]()
    for hz in (1, rate):
        past = new_past()
        past.scale[SQUARES, 0], past.scale[DOF, 0] = 4000.0, 400.0
        teach(past, FULL_STEP_S / hz, 30 * hz)
        ratios.append(past.scale[SQUARES, 0] / past.scale[DOF, 0])
    assert ratios[1] == pytest.approx(ratios[0], rel=0.02)
    assert 0.7 < ratios[0] < 10.0


@pytest.mark.parametrize("step_s", [0.9, 0.999, 1.0, 5.0, 30.0, nan])
def test_epochs_of_a_second_and_slower_count_in_full(step_s: float):
    """Bit for bit what was learned stays; a first epoch has no step."""
    past, plain = new_past(), new_past()
    teach(past, step_s, 50)
    for _ in range(50):
        learn_codes(plain.scale, TRIAL[:, : plain.scale.shape[1]])
        learn_phases(plain.scale, 30.0, 20.0)
    assert np.array_equal(past.scale, plain.scale)


def test_places_of_codes_are_left_alone():
    """They know of time themselves."""
    past = new_past()
    before = past.learned(0.1)
    past.scale[PHASE, PLACE_SQUARES:] = 7.0
    past.count_in_part(before, 0.1)
    assert (past.scale[PHASE, PLACE_SQUARES:] == 7.0).all()
