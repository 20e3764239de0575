"""The choice of integers when one antenna spoils it: that of the baselines that do not end there.

A receiver that is jammed, covered or reflected into has no right candidate in its tables, and no combination with it can be accepted. The
others know no less for that. So many looks find some combination by chance: each is asked to be as much surer.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from rtkmesh.attitude.candidates import Candidates
from rtkmesh.attitude.rigid_body import Layout
from rtkmesh.attitude.search import FAILURE_RATE, NOTHING_EXPECTED, Choice, Expectation, Verdict, choose

_WORTH_TRYING: Final = frozenset((Verdict.NO_COMBINATION, Verdict.NORM, Verdict.GEOMETRY, Verdict.CLOSURE, Verdict.NOT_SURE))
_SAME_M: Final = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Rest:
    """A choice without one antenna (its number in the layout).

    ``kept``: numbers of the tables that it is of; ``looks``: how many choices were tried.
    """

    antenna: int
    kept: tuple[int, ...]
    choice: Choice
    looks: int

    @property
    def wrong_probability(self) -> float:
        """Probability that it is wrong, with all the looks."""
        return min(1.0, self.looks * self.choice.wrong_probability)


def choose_without_one(
    layout: Layout, tables: Sequence[Candidates], refused: Choice, expected: Expectation = NOTHING_EXPECTED,
    failure_rate: float = FAILURE_RATE,
) -> Rest | None:  # fmt: skip
    """Return the surest accepted choice without one antenna, where the choice of all was ``refused``.

    None where there is none, or where others are accepted that do not agree with it on the baselines that they share.
    """
    antennas = sorted({antenna for table in tables for antenna in (table.start, table.end)})
    kept = {a: tuple(i for i, table in enumerate(tables) if a not in (table.start, table.end)) for a in antennas}
    tried = {antenna: rest for antenna, rest in kept.items() if any(not tables[i].known for i in rest)}
    if refused.verdict not in _WORTH_TRYING or not tried:
        return None
    choices = {a: choose(layout, [tables[i] for i in rest], expected, failure_rate / len(tried)) for a, rest in tried.items()}
    found = [Rest(a, tried[a], choice, len(tried)) for a, choice in choices.items() if choice.accepted]
    best = max(found, key=lambda rest: (len(rest.kept), rest.choice.log_odds), default=None)
    return best if best is not None and all(_agree(tables, best, other) for other in found) else None


def _agree(tables: Sequence[Candidates], one: Rest, other: Rest) -> bool:
    """Return whether two choices give the baselines that they share the same integers."""
    ours, theirs = (dict(zip(rest.kept, rest.choice.chosen, strict=True)) for rest in (one, other))
    gaps = (tables[i].baselines_ned_m[ours[i]] - tables[i].baselines_ned_m[theirs[i]] for i in ours.keys() & theirs.keys())
    return all(float(np.linalg.norm(gap)) < _SAME_M for gap in gaps)
