"""What scans over drawn runs have in common: levels of many factors are drawn, runs judged, and counted by factors and by pairs of these.

A scan (``Scan``) says which levels there are, how they are drawn, and what of them is simulated. Run K of a seed is the same however many
there are. ``main`` is the program: tables, or one run again.
"""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import combinations, count, islice, pairwise
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from arguments import add_data_unused, add_runs, parser_of
from campaign import COLUMNS as CAMPAIGN_COLUMNS
from campaign import Outcome, cells, figures, outcome, told, trace_of
from families import Random
from results import table
from rtkmesh.rtk.solution import Solution, Status
from simulated import Setup, Simulated, by_epoch, judge, simulate, solutions_of

Row = dict[str, Any]
Levels = dict[str, str]
Only = Mapping[str, frozenset[str]]

OFF: Final = "off"  # ambiguities
_RELATIVE: Final = (Status.FIX, Status.FLOAT, Status.DGPS)
COLUMNS: Final = ("level", *CAMPAIGN_COLUMNS[1:], "NEES without integers", "odd runs")
TWIN_COLUMNS: Final = (*COLUMNS, "right % of the twins", "never, but the twin does")


@dataclass(frozen=True, slots=True)
class Scan:
    """Runs to be drawn: ``program`` is the file that shows one again, ``levels`` has those of each factor.

    ``drawn`` draws the levels of a run from its seed and number, ``setup`` makes of these what is simulated; ``twin``, if there is one,
    the same run without what troubles it.
    """

    program: str
    runs: int
    quick_runs: int
    levels: Mapping[str, frozenset[str]]
    drawn: Callable[[int, int], Levels]
    setup: Callable[[int, int], tuple[Setup, Random]]
    twin: Callable[[int, int], tuple[Setup, Random]] | None = None


class Measured(NamedTuple):
    """A run: its levels, its figures, what must never be, and the figures of its twin."""

    run: int
    levels: Levels
    outcome: Outcome
    odd: tuple[str, ...] = ()
    twin: Outcome | None = None

    @property
    def never(self) -> bool:
        """Whether there is no right fix where the twin has one."""
        return self.twin is not None and np.isinf(self.outcome.first_right_s) and bool(np.isfinite(self.twin.first_right_s))

    @property
    def lost_pct(self) -> float:
        """How many fewer right fixes there are than the twin has, in % of the epochs in which there could be one."""
        return 0.0 if self.twin is None else _right_pct(self.twin) - _right_pct(self.outcome)


def _right_pct(o: Outcome) -> float:
    return 100.0 * (o.fixes - o.wrong) / max(o.possible, 1)


def simulated_run(scan: Scan, seed: int, run: int) -> Simulated:
    """Return a run."""
    return simulate(*scan.setup(seed, run))


def measure(scan: Scan, seed: int, run: int) -> Measured:
    """Simulate, solve and judge one run, and its twin."""
    found, odd = _judged(seed, run, simulated_run(scan, seed, run))
    twin = None if scan.twin is None else _judged(seed, run, simulate(*scan.twin(seed, run)))[0]
    return Measured(run, scan.drawn(seed, run), found, odd, twin)


def _judged(seed: int, run: int, simulated: Simulated) -> tuple[Outcome, tuple[str, ...]]:
    """Return the figures of a run and what must never be."""
    solutions: list[Solution] = []
    odd = ""
    try:
        solutions.extend(solutions_of(simulated))
    except Exception as error:  # noqa: BLE001  whatever it is, it is what is looked for
        odd = f"{type(error).__name__}: {error}"
    judged = judge(simulated, by_epoch(simulated, solutions))
    return outcome(f"{seed}:{run}", run, judged, simulated.setup.rate_hz), tuple(text for text in (odd, *oddities(solutions)) if text)


def oddities(solutions: Sequence[Solution]) -> Iterator[str]:
    """Yield what must never be of solutions: times that do not rise, values that are none, covariances and probabilities that cannot be."""
    falls = sum(b.time <= a.time for a, b in pairwise(solutions))
    if falls:
        yield f"{falls} times do not rise"
    for name, is_odd in _NEVER.items():
        if times := [s.time.tow_s for s in solutions if s.status is not Status.NONE and is_odd(s)]:
            yield f"{name} in {len(times)} epochs, first at {times[0]:.1f} s of the week"


def _no_values(s: Solution) -> bool:
    """Tell whether a position, or where there is one a baseline, is no number."""
    needed = (s.baseline_ecef_m, s.baseline_cov_ecef_m2) if s.status in _RELATIVE else ()
    return not all(np.isfinite(value).all() for value in (s.position_ecef_m, s.position_cov_ecef_m2, *needed))


def _no_covariance(s: Solution) -> bool:
    """Tell whether a covariance that is known is not symmetric, or has no positive diagonal or a variance below nothing somewhere."""
    known: list[NDArray[np.float64]] = [P for P in (s.position_cov_ecef_m2, s.velocity_cov_ecef_m2ps2) if np.isfinite(P).all()]
    return any(np.linalg.eigvalsh(P)[0] < -1e-9 * np.trace(P) or np.trace(P) <= 0.0 or not np.allclose(P, P.T) for P in known)


def _no_odds(s: Solution) -> bool:
    """Tell whether a probability or a protection level of a fix is none."""
    levels_m = (s.protection_horizontal_m, s.protection_vertical_m)
    return not 0.0 <= s.fix_probability <= 1.0 or min((m for m in levels_m if not np.isnan(m)), default=0.0) < 0.0


_NEVER: Final[Mapping[str, Callable[[Solution], bool]]] = {
    "values that are none": _no_values, "covariances that are none": _no_covariance, "probabilities that are none": _no_odds,
}  # fmt: skip


def picked(scan: Scan, seed: int, only: Only) -> Iterator[int]:
    """Yield the numbers of the runs of a seed that have the levels that are asked for."""
    for run in count():
        levels = scan.drawn(seed, run)
        if all(levels[factor] in allowed for factor, allowed in only.items()):
            yield run


def measured(scan: Scan, seed: int, runs: int, only: Only, jobs: int) -> list[Measured]:
    """Return the outcomes of so many runs, in order."""
    with ProcessPoolExecutor(jobs) as pool:
        return list(pool.map(partial(measure, scan, seed), islice(picked(scan, seed, only), runs), chunksize=4))


def row_of(found: Sequence[Measured]) -> Row:
    """Return the figures of runs: those with integers, and the floats of those without."""
    fixing = [m for m in found if m.levels["ambiguities"] != OFF]
    without = [m.outcome for m in found if m.levels["ambiguities"] == OFF]
    row = figures([m.outcome for m in fixing]) if fixing else {}
    twins = [m.twin for m in fixing if m.twin is not None]
    return row | {
        "nees_without_integers": figures(without)["nees_float"] if without else None,
        "odd_runs": sum(bool(m.odd) for m in found),
        "twin_right_pct": figures(twins)["right_pct"] if twins else None,
        "never": sum(m.never for m in fixing),
    }


def by_factor(scan: Scan, found: Sequence[Measured]) -> dict[str, dict[str, Row]]:
    """Return the figures of each level of each factor."""
    out: dict[str, dict[str, Row]] = {}
    for factor in scan.levels:
        levels = sorted({m.levels[factor] for m in found} - {OFF})
        out[factor] = {level: row_of([m for m in found if m.levels[factor] == level]) for level in levels}
    return out


def by_pairs(scan: Scan, found: Sequence[Measured]) -> dict[str, Row]:
    """Return the figures of the pairs of levels whose runs have wrong fixes more often than those of either level, the worst first."""
    out: dict[str, Row] = {}
    for one, other in combinations(scan.levels, 2):
        for a, b in sorted({(m.levels[one], m.levels[other]) for m in found if m.outcome.wrong}):
            both = [m for m in found if m.levels[one] == a and m.levels[other] == b]
            either = max(_bad_share([m for m in found if m.levels[one] == a]), _bad_share([m for m in found if m.levels[other] == b]))
            if sum(m.outcome.wrong > 0 for m in both) > 1 and _bad_share(both) > either:
                out[f"{one} {a}, {other} {b}"] = row_of(both)
    return dict(sorted(out.items(), key=lambda item: -item[1]["runs_with_wrong_pct_95"][0]))


def _bad_share(found: Sequence[Measured]) -> float:
    """Return the share of the runs with integers that have wrong fixes."""
    bad = [m.outcome.wrong > 0 for m in found if m.levels["ambiguities"] != OFF]
    return sum(bad) / max(len(bad), 1)


def replays(scan: Scan, found: Sequence[Measured]) -> Iterator[str]:
    """Yield the command that shows each run with wrong fixes, worst first."""
    for m in sorted((m for m in found if m.outcome.wrong), key=lambda m: (-m.outcome.wrong, m.run)):
        yield f"{_share_of(m.outcome)}: {_again(scan, m)}"


def wrong_twins(scan: Scan, found: Sequence[Measured]) -> Iterator[str]:
    """Yield the command that shows each twin with wrong fixes."""
    return (f"{_share_of(m.twin)}: {_again(scan, m, twin=True)}" for m in found if m.twin is not None and m.twin.wrong)


def _share_of(o: Outcome) -> str:
    return f"{o.wrong:4d} wrong of {o.fixes:4d}, {o.longest_wrong_s:5.1f} s, worst {o.worst_m:6.2f} m"


def odd_runs(scan: Scan, found: Sequence[Measured]) -> Iterator[str]:
    """Yield the command that shows each run in which something is that must never be."""
    return (f"{'; '.join(m.odd)}: {_again(scan, m)}" for m in found if m.odd)


def losses(scan: Scan, found: Sequence[Measured], least_pct: float = 50.0) -> Iterator[str]:
    """Yield the command that shows each run that has far fewer right fixes than its twin, worst first."""
    for m in sorted((m for m in found if m.lost_pct >= least_pct), key=lambda m: (-m.lost_pct, m.run)):
        yield f"{_right_pct(m.outcome):5.1f} % right, {m.lost_pct + _right_pct(m.outcome):5.1f} of the twin: {_again(scan, m)}"


def _again(scan: Scan, m: Measured, *, twin: bool = False) -> str:
    return f"{scan.program} --run {m.outcome.family}{' --twin' if twin else ''} --trace   {', '.join(m.levels.values())}"


def page(scan: Scan, rows: Mapping[str, Row]) -> str:
    """Return a table as Markdown."""
    return table(COLUMNS if scan.twin is None else TWIN_COLUMNS, [_cells(scan, level, row) for level, row in rows.items()])


def _cells(scan: Scan, level: str, row: Row) -> list[str]:
    known = cells(level, row) if "runs" in row else [level, *[""] * (len(CAMPAIGN_COLUMNS) - 1)]
    twin_pct = row["twin_right_pct"]
    twins = [] if scan.twin is None else ["" if twin_pct is None else f"{twin_pct:.1f}", str(row["never"])]
    return [*known, told(row["nees_without_integers"]), str(row["odd_runs"]), *twins]


def only_of(scan: Scan, text: str) -> dict[str, frozenset[str]]:
    """Return the levels of factors that a text asks for (ValueError: there is no such factor or level)."""
    out: dict[str, frozenset[str]] = {}
    for factor, _, levels in (part.partition("=") for part in text.split(",") if part):
        if factor not in scan.levels:
            raise ValueError(f"there is no factor {factor!r}; there are {', '.join(scan.levels)}")
        out[factor] = frozenset(levels.split("|"))
        if unknown := out[factor] - scan.levels[factor]:
            known = ", ".join(sorted(scan.levels[factor]))
            raise ValueError(f"{factor} has no level {', '.join(sorted(unknown))}; it has {known}")
    return out


def _report(scan: Scan, seed: int, found: Sequence[Measured]) -> None:
    """Print the tables."""
    rows = by_factor(scan, found)
    flat = {f"{factor} {level}": row for factor, levels in rows.items() for level, row in levels.items()}
    print(page(scan, flat | {"all": row_of(found)}))
    if pairs := by_pairs(scan, found):
        print(f"Pairs of levels whose runs have wrong fixes more often than those of either:\n\n{page(scan, pairs)}")
    lists = {
        "with wrong fixes": replays, "whose twins have wrong fixes": wrong_twins, "in which something is that must never be": odd_runs,
        "far behind their twins": losses,
    }  # fmt: skip
    for title, yields in lists.items():
        if commands := list(yields(scan, found)):
            print(f"Runs {title}, seed {seed}:\n\n```text\n" + "\n".join(commands) + "\n```")


def _one(scan: Scan, text: str, *, traced: bool, twin: bool) -> int:
    """Show one run, or its twin: its figures, or its epochs."""
    seed, run = (int(number) for number in text.split(":"))
    print(f"{text}: " + ", ".join(f"{factor} {level}" for factor, level in scan.drawn(seed, run).items()))
    if traced:
        print("\n".join(trace_of(text, simulate(*(scan.twin if twin and scan.twin else scan.setup)(seed, run)))))
    else:
        print(page(scan, {text: row_of([measure(scan, seed, run)])}))
    return 0


def main(scan: Scan, text: str | None) -> int:
    """Do what the arguments of the program say; ``text`` is its help."""
    parser = parser_of(text)
    add_runs(parser, f"in all (default {scan.runs})", f"{scan.quick_runs} runs")
    parser.add_argument("--only", default="", help="levels of factors: mode=static|static-start,systems=G")
    parser.add_argument("--run", metavar="SEED:K", help="this run alone")
    parser.add_argument("--trace", action="store_true", help="with --run: every epoch")
    if scan.twin is not None:
        parser.add_argument("--twin", action="store_true", help="with --trace: of its twin")
    add_data_unused(parser)
    options = parser.parse_args()
    if options.run:
        return _one(scan, options.run, traced=options.trace, twin=getattr(options, "twin", False))
    try:
        only = only_of(scan, options.only)
    except ValueError as error:
        parser.error(str(error))
    found = measured(scan, options.seed, options.runs or (scan.quick_runs if options.quick else scan.runs), only, options.jobs)
    if options.json:
        figures_of_all = {"factors": by_factor(scan, found), "pairs": by_pairs(scan, found), "replays": list(replays(scan, found))}
        lists = {"odd": list(odd_runs(scan, found)), "losses": list(losses(scan, found)), "twins": list(wrong_twins(scan, found))}
        print(json.dumps({"seed": options.seed} | figures_of_all | lists))
    else:
        _report(scan, options.seed, found)
    return 0
