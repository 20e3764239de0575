"""Named tuples on their way into kernels that Python calls in every epoch, and back: their fields alone.

At every call from Python numba looks at the types of all arguments, and of a named tuple at the names of all fields too: 10 of the 14 us
that the arguments of ``step.take_step`` took. So they cross as plain tuples, and get their names back on the other side.
"""

from rtkmesh._jit import kernel
from rtkmesh.models.single import Plain
from rtkmesh.rtk.integrity import IntegritySetup
from rtkmesh.rtk.matching import Rules
from rtkmesh.rtk.memory import ResolveSetup
from rtkmesh.rtk.relative import Setup, Solved
from rtkmesh.rtk.slips import SlipSetup
from rtkmesh.rtk.state import Filter


def plain(setup: Setup) -> Plain:
    """Return the options without names, in them neither."""
    return tuple(tuple(part) if isinstance(part, tuple) else part for part in setup)


@kernel
def unnamed(solved: Solved) -> Plain:
    """Return a relative solution without names: numba gives it to Python sooner."""
    f, informed = solved.filter, solved.informed
    return (
        solved.status, (f.x, f.P, f.keys, f.history), (informed.x, informed.P, informed.keys, informed.history), solved.x, solved.P,
        solved.figures, solved.satellites, solved.position_cov_m2, solved.place,
    )  # fmt: skip


def renamed(solved: Plain) -> Solved:
    """Return the relative solution that ``unnamed`` had."""
    return Solved(solved[0], Filter(*solved[1]), Filter(*solved[2]), *solved[3:])


@kernel
def named(setup: Plain) -> Setup:
    """Return the options that ``plain`` had."""
    return Setup(Rules(*setup[0]), SlipSetup(*setup[1]), ResolveSetup(*setup[2]), IntegritySetup(*setup[3]), *setup[4:])
