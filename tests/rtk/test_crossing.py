"""What crosses into kernels without names is the same on the other side."""

from dataclasses import replace

import numpy as np
import pytest

from rtkmesh.rtk.crossing import named, plain
from rtkmesh.rtk.options import AmbiguityMode, AmbiguityOptions, DynamicsOptions, Mode, RtkOptions
from rtkmesh.rtk.setup import setup_of

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
