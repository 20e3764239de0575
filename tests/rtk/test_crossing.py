"""What crosses into kernels without names is the same on the other side."""

from dataclasses import replace

import numpy as np
import pytest

from rtkmesh.rtk.crossing import named, plain, renamed, unnamed
from rtkmesh.rtk.options import AmbiguityMode, AmbiguityOptions, DynamicsOptions, Mode, RtkOptions
from rtkmesh.rtk.relative import SOLVED, Solved
from rtkmesh.rtk.setup import setup_of
from rtkmesh.rtk.state import Filter

PLAIN = RtkOptions()
OTHERS = {
    "usual": PLAIN,
    "moving base": replace(PLAIN, mode=Mode.MOVING_BASE, baseline_length_m=1.5, baseline_sigma_m=0.01, systems="GE", frequencies=1),
    "held": replace(PLAIN, ambiguity=AmbiguityOptions(mode=AmbiguityMode.FIX_AND_HOLD, failure_rate=0.02), excluded=("G05",)),
    "alone": replace(PLAIN, ambiguity=AmbiguityOptions(mode=AmbiguityMode.INSTANTANEOUS), dynamics=DynamicsOptions(ambiguity_cyc=0.5)),
}


@pytest.mark.parametrize("options", OTHERS.values(), ids=OTHERS)
def test_options_get_their_names_back(options):
    """Every field of every part is where it was, antennas that were taken later too."""
    setup = setup_of(options)._replace(antennas=np.arange(3.0))
    back = named(plain(setup))
    assert type(back) is type(setup)
    for name, before, after in zip(setup._fields, setup, back, strict=True):
        assert type(after) is type(before), name
        np.testing.assert_equal(after, before, name)


def test_a_solution_gets_its_names_back():
    """Every field is where it was, those of both filters too."""
    f, informed = (Filter(np.full(10, k), np.full((10, 10), k), np.full(1, 7), np.full((1, 3), k)) for k in (1.0, 2.0))
    solved = Solved(
        SOLVED, f, informed, np.full(9, 3.0), np.full((9, 9), 4.0), np.full(22, 5.0), np.full((2, 14), 6.0), np.full((3, 3), 7.0),
        (np.full(10, 8.0), np.full((10, 10), 9.0)),
    )  # fmt: skip
    back = renamed(unnamed(solved))
    assert (type(back), type(back.filter), type(back.informed)) == (Solved, Filter, Filter)
    for before, after in zip(
        (*solved[:1], *f, *informed, *solved[3:-1], *solved.place),
        (*back[:1], *back.filter, *back.informed, *back[3:-1], *back.place),
        strict=True,
    ):
        np.testing.assert_array_equal(after, before)
