#!/usr/bin/env python3
"""Single epochs of few satellites, without and with the length known: what algorithms.md A4 measured, on our engine.

  attitude_subsets.py [--data DIR] [--quick] [--json]

Recording tokyo_static (two antennas 0.99 m apart), one frequency of GPS, Galileo and QZSS: random epochs, each by itself, of random
satellites, by the number of double differences; the engine has learned the receivers' noise before, and nothing else. Right is within
5 cm of the median of the fixes with all systems and bands. `best right`: the best integers are right, in % of the trials; `accepted /
wrong`: in % of the trials, and wrong ones of these, in % for a ratio of 3, else by number. `engine`: a solver, without and with its length
told (1 cm); `shape`: `attitude.search.choose` with the same length and candidates. In brackets: the reference's (algorithms.md A4).
"""

import argparse
import json
import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import kernel_cache  # noqa: F401  first of all
from attitude_search import CASE, LENGTH_M, candidates, median_baseline, options, run_of
from cases import Case, data_folder, load
from results import table
from rtkmesh.attitude.rigid_body import Layout
from rtkmesh.attitude.rotation import NED_FROM_ENU
from rtkmesh.attitude.search import Verdict, choose
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.frames import enu_from_ecef_at
from rtkmesh.gnss.signals import satellite_id
from rtkmesh.rtk.candidates import CandidateTable
from rtkmesh.rtk.engine import Rtk
from rtkmesh.rtk.options import AmbiguityMode, RtkOptions
from rtkmesh.rtk.solution import Solution, Status

Vector = NDArray[np.float64]

SYSTEMS: Final = "GEJ"
COUNTS: Final = range(3, 10)  # double differences; 9: that many or more
SIGMA_M: Final = 0.01  # of the length
# algorithms.md A4 by double differences: best right %, ratio 3 accepted / wrong %; the same with the length.
REFERENCE: Final = {
    3: ("1", "23 / 97", "22", "58 / 67"), 4: ("12.5", "11 / 81", "73", "80 / 17"), 5: ("53", "17 / 11", "96.5", "95 / 2.4"),
    6: ("90", "47 / 0.9", "99.5", "98 / 0.2"), 7: ("97.7", "79 / 0", "100", "100 / 0"), 8: ("99.8", "92 / 0", "100", "100 / 0"),
    9: ("100", "99 / 0", "100", "100 / 0"),
}  # fmt: skip
COLUMNS: Final = (
    "n", "trials", "best right %", "ratio 3: accepted / wrong %", "engine: accepted % / wrong", "length: best right %",
    "length, ratio 3: accepted / wrong %", "length, engine: accepted % / wrong", "shape: best right %", "shape: accepted % / wrong",
)  # fmt: skip
Given = tuple[tuple[Any, ...], dict[str, Any]]  # arguments of a step
_RIGHT_M: Final = 0.05
_LAYOUT: Final = Layout(("base", "rover"), np.array([[0.0, 0.0, 0.0], [LENGTH_M, 0.0, 0.0]]), np.eye(6) * SIGMA_M**2 / 2.0)


class Listening(Rtk):
    """An engine that keeps what it is given."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.given: list[Given] = []

    def step(self, *arguments: Any, **more: Any) -> Solution:
        """Solve, and keep the arguments."""
        self.given.append((arguments, more))
        return super().step(*arguments, **more)


@dataclass(slots=True)
class Tally:
    """What became of the trials of one number of double differences: (best right, accepted, accepted and wrong) per way."""

    trials: int = 0
    ways: defaultdict[str, list[int]] = field(default_factory=lambda: defaultdict(lambda: [0, 0, 0]))

    def add(self, way: str, *, right: bool, accepted: bool) -> None:
        """Count a trial of a way."""
        row = self.ways[way]
        row[0], row[1], row[2] = row[0] + right, row[1] + accepted, row[2] + (accepted and not right)


def told(length_m: float | None) -> RtkOptions:
    """Return a solver's options."""
    return replace(options(SYSTEMS, 1, AmbiguityMode.INSTANTANEOUS, length_m), baseline_sigma_m=SIGMA_M)


def recorded_epochs(case: Case) -> list[Given]:
    """Return what an engine is given at the epochs of a recording that have a baseline."""
    run = run_of(case, told(None))
    run.session.engine = engine = Listening(told(None))
    usable = [np.isfinite(solution.baseline_ecef_m).all() for solution in run.solutions()]
    return [given for given, good in zip(engine.given, usable, strict=True) if good]


def learned(epochs: Sequence[Given], length_m: float | None) -> Rtk:
    """Return an engine that has seen the recording with all satellites and forgotten all but the noise of the receivers."""
    engine = Rtk(told(length_m))
    for arguments, more in epochs:
        engine.step(*arguments, **more)
    engine.reset()
    return engine


def trials(epochs: Sequence[Given], count: int, seed: int = 1) -> Iterator[tuple[Given, tuple[str, ...]]]:
    """Yield random epochs, and which satellites are to be left out."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        arguments, more = epochs[int(rng.integers(len(epochs)))]
        names = seen(arguments[0], arguments[1])
        chosen = rng.permutation(len(names))[: int(rng.integers(6, 14))]
        yield (arguments, more), tuple(name for number, name in enumerate(names) if number not in chosen)


def seen(rover: Epoch, base: Epoch) -> list[str]:
    """Return the satellites of the systems that both see."""
    both = np.intersect1d(rover.satellite, base.satellite)
    return [name for name in map(satellite_id, both.tolist()) if name[0] in SYSTEMS]


def solved(engine: Rtk, given: Given, without: tuple[str, ...]) -> tuple[Solution, CandidateTable | None]:
    """Return the solution of one epoch without some satellites, and its candidates; the engine learns nothing."""
    one, (arguments, more) = deepcopy(engine), given
    one.go_on(replace(one.options, excluded=without))
    return one.step(*arguments, **more), one.candidates()


def measured(case: Case, count: int) -> dict[int, Tally]:
    """Return what became of so many trials, by the number of double differences."""
    true, tallies, epochs = median_baseline(case), defaultdict[int, Tally](Tally), recorded_epochs(case)
    engines = [learned(epochs, length_m) for length_m in (None, LENGTH_M)]
    for given, without in trials(epochs, count):
        (plain, free), (known, constrained) = (solved(engine, given, without) for engine in engines)
        if free is None or constrained is None or free.count < COUNTS[0] or free.count != constrained.count:
            continue
        tally = tallies[min(free.count, COUNTS[-1])]
        tally.trials += 1
        for way, found, solution in (("plain", free, plain), ("length", constrained, known)):
            totals = found.norms if way == "plain" else found.norms + misfits(found)
            best, second = np.argsort(totals)[:2]
            right = _is_right(found.baselines_ecef_m[best], true)
            tally.add(f"{way} ratio", right=right, accepted=bool(totals[second] >= 3.0 * totals[best]))
            fixed = solution.status is Status.FIX
            tally.add(f"{way} engine", right=_is_right(solution.baseline_ecef_m, true) if fixed else right, accepted=fixed)
        turn = NED_FROM_ENU @ enu_from_ecef_at(known.base_ecef_m)
        choice = choose(_LAYOUT, [candidates(constrained, 0, 1, turn)])
        right = choice.verdict is not Verdict.NO_COMBINATION and _is_right(constrained.baselines_ecef_m[choice.chosen[0]], true)
        tally.add("shape", right=right, accepted=choice.accepted)
    return dict(tallies)


def misfits(found: CandidateTable) -> Vector:
    """Return the squared misfit of the length of each candidate."""
    length = np.linalg.norm(found.baselines_ecef_m, axis=1)
    along = found.baselines_ecef_m / length[:, None]
    variance = SIGMA_M**2 + np.einsum("mi,ij,mj->m", along, found.cov_ecef_m2, along)
    return (length - LENGTH_M) ** 2 / variance


def _is_right(baseline_ecef_m: Vector, true_ecef_m: Vector) -> bool:
    return bool(np.linalg.norm(baseline_ecef_m - true_ecef_m) < _RIGHT_M)


def page(tallies: dict[int, Tally]) -> str:
    """Return the table as Markdown."""
    return table(COLUMNS, [_cells(count, tallies[count]) for count in sorted(tallies)])


def _cells(count: int, tally: Tally) -> Sequence[str]:
    share, theirs = 100.0 / tally.trials, REFERENCE[count]

    def right(way: str, reference: str = "") -> str:
        return f"{share * tally.ways[way][0]:.1f}" + (f" ({reference})" if reference else "")

    def ratio(way: str, reference: str) -> str:
        _, accepted, wrong = tally.ways[way]
        return f"{share * accepted:.0f} / {100.0 * wrong / max(accepted, 1):.1f} ({reference})"

    def ours(way: str) -> str:
        return f"{share * tally.ways[way][1]:.1f} / {tally.ways[way][2]}"

    return [
        f"{count}" + ("+" if count == COUNTS[-1] else ""), str(tally.trials),
        right("plain ratio", theirs[0]), ratio("plain ratio", theirs[1]), ours("plain engine"),
        right("length ratio", theirs[2]), ratio("length ratio", theirs[3]), ours("length engine"), right("shape"), ours("shape"),
    ]  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of the recordings")
    parser.add_argument("--quick", action="store_true", help="300 trials instead of 6300")
    parser.add_argument("--json", action="store_true", help="all figures, for programs")
    chosen = parser.parse_args()
    data = chosen.data or data_folder()
    if data is None:
        print("attitude_subsets: no recordings: set RTKMESH_DATA or give --data", file=sys.stderr)
        return 2
    tallies = measured(load(data, [CASE])[0], 300 if chosen.quick else 6300)
    rows = [{"double_differences": n, "trials": t.trials, **t.ways} for n, t in sorted(tallies.items())]
    print(json.dumps(rows, indent=1) if chosen.json else page(tallies))
    return 0


if __name__ == "__main__":
    sys.exit(main())
