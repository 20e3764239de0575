"""Named tuples on their way into kernels that Python calls in every epoch: their fields alone.

At every call from Python numba looks at the types of all arguments, and of a named tuple at the names of all fields too: 10 of the 14 us
that the arguments of ``step.take_step`` took. So they cross as plain tuples, and get their names back on the other side.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.gnss.epoch import Epoch, Signals
from rtkmesh.models.ephemeris_table import Issues
from rtkmesh.models.single import Located, PointSetup, locate
from rtkmesh.rtk.integrity import IntegritySetup
from rtkmesh.rtk.matching import Rules
from rtkmesh.rtk.memory import ResolveSetup
from rtkmesh.rtk.relative import Setup
from rtkmesh.rtk.slips import SlipSetup

Vector = NDArray[np.float64]
Plain = tuple[Any, ...]  # the fields of a named tuple


def plain(setup: Setup) -> Plain:
    """Return the options without names, in them neither."""
    return tuple(tuple(part) if isinstance(part, tuple) else part for part in setup)


@kernel
def named(setup: Plain) -> Setup:
    """Return the options that ``plain`` had."""
    return Setup(Rules(*setup[0]), SlipSetup(*setup[1]), ResolveSetup(*setup[2]), IntegritySetup(*setup[3]), *setup[4:])


def locate_epoch(epoch: Epoch, issues: Issues, setup: PointSetup, start_ecef_m: Vector) -> Located:
    """Find position and velocity of a receiver as ``locate`` does."""
    return _locate(tuple(epoch.signals), tuple(issues), tuple(setup), start_ecef_m)


@kernel
def _locate(signals: Plain, issues: Plain, setup: Plain, start_ecef_m: Vector) -> Located:
    return locate(Signals(*signals), Issues(*issues), PointSetup(*setup), start_ecef_m)
