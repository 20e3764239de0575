#!/usr/bin/env python3
"""Does the engine know when it is right? More than a thousand short simulated runs, judged by the truth they were made from.

  campaign.py [--runs N] [--seed S] [--only NAME,...] [--rate HZ] [--base-rate HZ] [--json] [--jobs N]
  campaign.py --only urban --run 17 [--seed S] --trace        one run again, epoch by epoch

Runs of 75 to 185 s, --runs in all (a family gets its equal share; the 17th run of a family is the same however many there are). With
--rate the rover has so many epochs in each of the same seconds, and so has the base, unless --base-rate says otherwise (rates.py compares).
Observations go through a live Session; see simulated.py for how, families.py for what.

Columns, of the epochs in which the rover tracks five satellites or more: fixes and right fixes in %; wrong fixes (off by more than 0.15 m
in 3D) in % of the fixes with bounds of 95 % confidence as if fixes were independent, which they are not; runs with any wrong fix in % of
the runs with bounds, which are; longest run of wrong fixes (s); time from the first such epoch to the first right fix (s, 50 % / 95 % of
the runs; '>' where so many runs never had one); normalised error squared e' P^-1 e / 3 of fixes and floats (1 is honest, more is too sure):
mean, and mean without the largest 5 %.

A second table says what the option failure_rate of [solver.ID.ambiguity] makes of the same runs: it hides fixes and changes nothing else;
a third the same of each family that has wrong fixes, as wrong / fixes, with ! where the share of these is above the configured rate.
"""

import argparse
import json
import sys
import zlib
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

import kernel_cache  # noqa: F401  first of all
from arguments import add_data_unused, add_runs, parser_of
from bounds import clopper_pearson
from families import FAMILIES, Family, named
from results import table
from rtkmesh.gnss.signals import satellite_id, signal_code
from rtkmesh.rtk.solution import Reason, Solution, Status
from rtkmesh.simulation.sky import absolute_s
from score_pos import longest_run
from simulated import Judged, Simulated, judge, simulate, solve

Row = dict[str, Any]

RATES = (1.0, 0.3, 0.1, 0.01, 1e-3, 1e-4)
RATE_COLUMNS = ("failure_rate", "fix %", "wrong fixes", "wrong share (95 %)", "runs with wrong")
RUNS = 1380
QUICK_RUNS = 138
COLUMNS = (
    "family", "runs", "epochs", "fix %", "right %", "wrong fixes", "wrong % of fixes (95 %)", "runs with wrong", "% of runs (95 %)",
    "longest wrong s", "first right fix s", "NEES fix", "NEES float",
)  # fmt: skip
_TRIMMED = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What a run came to."""

    family: str
    run: int
    possible: int
    fixes: int
    wrong: int
    longest_wrong_s: float
    worst_m: float
    first_right_s: float  # inf: never
    fix_squares: NDArray[np.float64]
    float_squares: NDArray[np.float64]
    doubt: NDArray[np.float64]  # of the fixes: the published probability of being wrong, and
    is_wrong: NDArray[np.bool_]  # whether they are


def random_of(family: Family, seed: int, run: int) -> np.random.Generator:
    """Return the random numbers of a run of a family."""
    return np.random.default_rng((seed, zlib.crc32(family.name.encode()), run))


class Rates(NamedTuple):
    """Epochs of rover and base in a second; ``base_hz`` 0: as many as the rover's."""

    rover_hz: int = 1
    base_hz: int = 0


ONE_HZ: Final = Rates()


def simulated_run(family: Family, seed: int, run: int, rates: Rates = ONE_HZ) -> Simulated:
    """Return a run of a family."""
    rng = random_of(family, seed, run)
    return simulate(replace(family.make(rng), rate_hz=rates.rover_hz, base_rate_hz=rates.base_hz), rng)


def measure(name: str, seed: int, run: int, rates: Rates = ONE_HZ) -> Outcome:
    """Simulate, solve and judge one run."""
    (family,) = named(name)
    simulated = simulated_run(family, seed, run, rates)
    return outcome(name, run, judge(simulated, solve(simulated)), rates.rover_hz)


def outcome(name: str, run: int, judged: Judged, rate_hz: float = 1.0) -> Outcome:
    """Return the figures of a judged run; ``rate_hz``: so many epochs are one of the unit that times are told in."""
    counted = judged.possible
    fixed, wrong = judged.fixed & counted, judged.wrong & counted
    right = np.flatnonzero(fixed & ~wrong)
    first = int(np.argmax(counted))
    errors_m = np.linalg.norm(judged.error_enu_m, axis=1)
    known = np.isfinite(judged.normalised)
    floating = judged.status == int(Status.FLOAT)
    return Outcome(
        name, run, int(counted.sum()), int(fixed.sum()), int(wrong.sum()), longest_run(wrong) / rate_hz,
        float(errors_m[wrong].max(initial=0.0)), (right[0] - first) / rate_hz if len(right) else float("inf"),
        judged.normalised[fixed & known], judged.normalised[floating & counted & known], judged.doubt[fixed], wrong[fixed],
    )  # fmt: skip


def figures(outcomes: Sequence[Outcome]) -> Row:
    """Return the figures of many runs."""
    possible, fixes, wrong = (sum(getattr(o, name) for o in outcomes) for name in ("possible", "fixes", "wrong"))
    bad_runs = [o for o in outcomes if o.wrong]
    first = np.sort([o.first_right_s for o in outcomes])
    return {
        "runs": len(outcomes),
        "epochs": possible,
        "fix_pct": _percent(fixes, possible),
        "right_pct": _percent(fixes - wrong, possible),
        "wrong_fixes": wrong,
        "wrong_pct_of_fixes": _percent(wrong, fixes),
        "wrong_pct_of_fixes_95": [100.0 * bound for bound in clopper_pearson(wrong, fixes)],
        "runs_with_wrong": len(bad_runs),
        "runs_with_wrong_pct": _percent(len(bad_runs), len(outcomes)),
        "runs_with_wrong_pct_95": [100.0 * bound for bound in clopper_pearson(len(bad_runs), len(outcomes))],
        "longest_wrong_s": max(o.longest_wrong_s for o in outcomes),
        "worst_m": round(max(o.worst_m for o in outcomes), 3),
        "first_right_s": [_finite(first[min(int(q * len(first)), len(first) - 1)]) for q in (0.5, 0.95)],
        "nees_fix": _means(np.concatenate([o.fix_squares for o in outcomes])),
        "nees_float": _means(np.concatenate([o.float_squares for o in outcomes])),
    }


def by_rate(outcomes: Sequence[Outcome]) -> list[Row]:
    """Return what is left of the fixes of many runs under each configured failure rate."""
    possible = sum(o.possible for o in outcomes)
    return [_of_rate(rate, possible, [o.is_wrong[o.doubt <= rate] for o in outcomes]) for rate in RATES]


def _of_rate(rate: float, possible: int, shown: Sequence[NDArray[np.bool_]]) -> Row:
    fixes, wrong = sum(len(s) for s in shown), sum(int(s.sum()) for s in shown)
    share = wrong / fixes if fixes else 0.0
    bad = sum(bool(s.any()) for s in shown)
    return {
        "failure_rate": rate, "fixes": fixes, "fix_pct": _percent(fixes, possible), "wrong_fixes": wrong, "share": share,
        "share_95": clopper_pearson(wrong, fixes), "runs_with_wrong": bad,
    }  # fmt: skip


def rate_page(rows: Sequence[Row]) -> str:
    """Return the table of failure rates as Markdown."""
    return table(RATE_COLUMNS, [
        [f"{row['failure_rate']:g}", f"{row['fix_pct']:.1f}", str(row["wrong_fixes"]),
         f"{row['share']:.1e} ({row['share_95'][0]:.1e} to {row['share_95'][1]:.1e})", str(row["runs_with_wrong"])]
        for row in rows
    ])  # fmt: skip


def family_rate_page(families: Sequence[Family], outcomes: Sequence[Outcome]) -> str:
    """Return the table of failure rates of the families that have wrong fixes, as Markdown."""
    rows = {family.name: by_rate([o for o in outcomes if o.family == family.name]) for family in families}
    return table(("family", *(f"{rate:g}" for rate in RATES)), [
        [name, *(f"{row['wrong_fixes']} / {row['fixes']}{'!' if row['share'] > row['failure_rate'] else ''}" for row in rates)]
        for name, rates in rows.items() if rates[0]["wrong_fixes"]
    ])  # fmt: skip


def _percent(part: int, whole: int) -> float:
    return 100.0 * part / whole if whole else 0.0


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _means(values: NDArray[np.float64]) -> list[float] | None:
    """Return the mean, and the mean without the largest values."""
    if not len(values):
        return None
    kept = np.sort(values)[: max(1, round((1.0 - _TRIMMED) * len(values)))]
    return [float(values.mean()), float(kept.mean())]


def page(rows: dict[str, Row]) -> str:
    """Return the table of all families as Markdown."""
    titles = {family.name: f"{family.name}: {family.title}" for family in FAMILIES}
    return table(COLUMNS, [cells(titles.get(name, name), row) for name, row in rows.items()])


def cells(title: str, row: Row) -> list[str]:
    """Return the cells of a row of COLUMNS."""
    first = " / ".join(">" if value is None else f"{value:.3g}" for value in row["first_right_s"])
    return [
        title, str(row["runs"]), str(row["epochs"]), f"{row['fix_pct']:.1f}", f"{row['right_pct']:.1f}", str(row["wrong_fixes"]),
        _bounded(row["wrong_pct_of_fixes"], row["wrong_pct_of_fixes_95"]), str(row["runs_with_wrong"]),
        _bounded(row["runs_with_wrong_pct"], row["runs_with_wrong_pct_95"]), f"{row['longest_wrong_s']:g}", first,
        told(row["nees_fix"]), told(row["nees_float"]),
    ]  # fmt: skip


def told(means: Sequence[float] | None) -> str:
    """Return the cell of normalised squared errors."""
    return "" if means is None else " / ".join(_short(mean) for mean in means)


def _short(value: float) -> str:
    return f"{value:.2f}" if value < 100.0 else f"{value:.0f}"


def _bounded(value: float, bounds: Sequence[float]) -> str:
    return f"{value:.2f} ({bounds[0]:.2f} to {bounds[1]:.2f})"


def campaign(families: Sequence[Family], runs: int, seed: int, jobs: int, rates: Rates = ONE_HZ) -> list[Outcome]:
    """Return the outcomes of all runs, in order, from as many processes as ``jobs``."""
    each = -(-runs // len(families))
    work = [(family.name, seed, run, rates) for family in families for run in range(each)]
    done: dict[tuple[str, int], Outcome] = {}
    with ProcessPoolExecutor(jobs) as pool:
        waiting = {pool.submit(measure, *item): item for item in work}
        finished = as_completed(waiting)
        for future in track(finished, "runs", len(work), console=Console(stderr=True), disable=not sys.stderr.isatty()):
            result = future.result()
            done[result.family, result.run] = result
    return [done[name, run] for name, _, run, _ in work]


def rows_of(families: Sequence[Family], outcomes: Sequence[Outcome]) -> dict[str, Row]:
    """Return the figures per family and in total."""
    rows = {family.name: figures([o for o in outcomes if o.family == family.name]) for family in families}
    return rows if len(families) == 1 else rows | {"total": figures(outcomes)}


def replays(outcomes: Iterable[Outcome], seed: int, rates: Rates = ONE_HZ) -> Iterator[str]:
    """Yield the command that shows each run with wrong fixes, worst first."""
    at = "" if rates == ONE_HZ else f"--rate {rates.rover_hz} --base-rate {rates.base_hz} "
    for o in sorted((o for o in outcomes if o.wrong), key=lambda o: (-o.wrong, o.family, o.run)):
        yield f"{o.wrong:4d} wrong, worst {o.worst_m:6.2f} m: campaign.py --only {o.family} --run {o.run} --seed {seed} {at}--trace"


def trace(family: Family, seed: int, run: int, rates: Rates = ONE_HZ) -> Iterator[str]:
    """Yield one line per epoch of a run of a family."""
    return trace_of(f"{family.name} run {run} seed {seed}", simulated_run(family, seed, run, rates))


def trace_of(title: str, simulated: Simulated) -> Iterator[str]:
    """Yield one line per epoch of a run."""
    solutions = solve(simulated)
    judged = judge(simulated, solutions)
    tag = simulated.rover[0].epoch.time
    length_m = np.linalg.norm(simulated.baseline_ecef_m[0])
    yield f"{title}: starts {tag.week} {tag.tow_s:.0f}, baseline {length_m:.1f} m"
    for side, d in simulated.disturbances:
        signal = "all signals" if d.signal is None else signal_code(d.signal)
        about = f"code {d.code_m:+.1f} m {d.code_rate_mps:+.2f} m/s, phase {d.phase_cyc:+.0f} cycles"
        yield f"fault of the {side} from epoch {d.start_s - absolute_s(tag):.0f}: {satellite_id(d.satellite)} {signal}, {about}"
    yield from lines_of(solutions, judged)


def lines_of(solutions: Sequence[Solution | None], judged: Judged) -> Iterator[str]:
    """Yield a line per epoch of judged solutions, under their titles."""
    yield "epoch status reason               error E, N, U m               sigma 3D m   sq/3  ratio grade fixed/amb sats age s"
    for k, solution in enumerate(solutions):
        mark = " WRONG" if judged.wrong[k] else ""
        yield f"{k:5d} " + ("no solution" if solution is None else _trace_line(solution, judged, k) + mark)


def _trace_line(s: Solution, judged: Judged, k: int) -> str:
    east, north, up = judged.error_enu_m[k]
    sigma_m = float(np.sqrt(np.trace(s.baseline_cov_ecef_m2)))
    return (
        f"{Status(s.status).name:6} {Reason(s.reason).name:20} {east:+9.3f} {north:+9.3f} {up:+9.3f} {sigma_m:10.4f} "
        f"{judged.normalised[k]:8.2f} {s.ratio:6.1f} {s.grade:3d} {s.ambiguities_fixed:5d}/{s.ambiguities:3d} "
        f"{s.satellites_used:4d} {s.age_s:5.1f}"
    )


def main() -> int:
    options = _options()
    families = named(options.only)
    if options.run is not None:
        return _one(families[0], options)
    outcomes = campaign(families, options.runs or (QUICK_RUNS if options.quick else RUNS), options.seed, options.jobs, _rates(options))
    rows = rows_of(families, outcomes)
    commands = list(replays(outcomes, options.seed, _rates(options)))
    if options.json:
        rates = by_rate(outcomes)
        print(json.dumps({"seed": options.seed, "families": rows, "failure_rates": rates, "replays": commands}, indent=1))
        return 0
    print(page(rows))
    print(f"What a configured failure rate leaves of them (1: no limit):\n\n{rate_page(by_rate(outcomes))}")
    if commands:
        print(f"By family, wrong / fixes at each failure rate:\n\n{family_rate_page(families, outcomes)}")
        print(f"Runs with wrong fixes, seed {options.seed}:\n\n```text\n" + "\n".join(commands) + "\n```")
    return 0


def _one(family: Family, options: argparse.Namespace) -> int:
    """Show one run: its epochs or its figures."""
    if options.trace:
        print("\n".join(trace(family, options.seed, options.run, _rates(options))))
        return 0
    row = figures([measure(family.name, options.seed, options.run, _rates(options))])
    print(json.dumps(row, indent=1) if options.json else page({family.name: row}))
    return 0


def _rates(options: argparse.Namespace) -> Rates:
    return Rates(options.rate, options.base_rate)


def _options() -> argparse.Namespace:
    parser = parser_of(__doc__)
    add_runs(parser, f"in all families together (default {RUNS})", f"{QUICK_RUNS} runs")
    parser.add_argument("--only", help="names of families, with commas between")
    parser.add_argument("--run", type=int, help="this run of one family alone")
    parser.add_argument("--trace", action="store_true", help="with --run: every epoch")
    parser.add_argument("--rate", type=int, default=1, help="epochs of the rover in a second")
    parser.add_argument("--base-rate", type=int, default=0, help="epochs of the base in a second (0: as many as the rover's)")
    add_data_unused(parser)
    options = parser.parse_args()
    try:
        named(options.only)
    except ValueError as error:
        parser.error(str(error))
    if options.run is not None and (not options.only or "," in options.only):
        parser.error("--run is a run of one family: name it with --only")
    return options


if __name__ == "__main__":
    sys.exit(main())
