#!/usr/bin/env python3
"""Is the engine as right and as honest at 5 and 10 Hz as at 1 Hz? Runs of the campaign, each at several rates.

  rates.py [--runs N] [--seed S] [--only NAME,...] [--rates 1,5,10,10/1] [--quick] [--json] [--jobs N]

A rate is that of the rover and the base, or both with a slash between (10/1: the base sends once a second). A run lasts as many seconds at
every rate, at the same place and time, with the same faults; its noise is another. Columns as those of campaign.py; the last one is of
the same runs without integers (AmbiguityMode.OFF): normalised error squared of every float, mean and mean of the lower 95 %.
"""

import json
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import kernel_cache  # noqa: F401  first of all
from arguments import add_runs, parser_of
from campaign import Outcome, Rates, figures, outcome, simulated_run
from families import FAMILIES, Family, named
from results import table
from rtkmesh.rtk.options import AmbiguityMode
from sigmas import of_run
from simulated import judge, solve

Row = dict[str, Any]

RUNS: Final = 60
QUICK_RUNS: Final = 6  # 4 minutes on two cores that do nothing else
TELLING: Final = ("open", "open_f9p_l1", "open_m8_l1", "tunnel", "dive_told", "slips", "slips_l1", "urban", "forest")
RATES: Final = "1,5,10,10/1"
COLUMNS: Final = (
    "family", "Hz", "epochs", "fix %", "right %", "wrong fixes", "wrong % of fixes", "runs with wrong", "longest wrong s",
    "first right fix s", "NEES fix", "NEES float", "NEES without integers",
)  # fmt: skip


def measure(seed: int, item: tuple[str, int, Rates]) -> tuple[Outcome, NDArray[np.float64]]:
    """Return the outcome of a run, and the normalised squares of its floats without integers."""
    name, run, rates = item
    simulated = simulated_run(next(f for f in FAMILIES if f.name == name), seed, run, rates)
    found = outcome(name, run, judge(simulated, solve(simulated)), rates.rover_hz)
    return found, of_run(simulated, AmbiguityMode.OFF).squares()


def measured(families: Sequence[Family], all_rates: Sequence[Rates], runs: int, seed: int, jobs: int) -> Iterator[Row]:
    """Yield a row per family and rate."""
    with ProcessPoolExecutor(jobs) as pool:
        for family in families:
            for rates in all_rates:
                found = list(pool.map(partial(measure, seed), [(family.name, run, rates) for run in range(runs)]))
                yield _row(family, rates, found)


def _row(family: Family, rates: Rates, found: Sequence[tuple[Outcome, NDArray[np.float64]]]) -> Row:
    squares = np.sort(np.concatenate([floats for _, floats in found]))
    means = [float(squares.mean()), float(squares[: max(1, round(0.95 * len(squares)))].mean())] if len(squares) else None
    row = figures([outcome for outcome, _ in found])
    return {"family": family.name, "title": family.title, "hz": _told(rates)} | row | {"nees_without_integers": means}


def _told(rates: Rates) -> str:
    return f"{rates.rover_hz}/{rates.base_hz}" if rates.base_hz else str(rates.rover_hz)


def page(rows: Sequence[Row]) -> str:
    """Return the table as Markdown."""
    return table(COLUMNS, [_cells(row) for row in rows])


def _cells(row: Row) -> list[str]:
    first = " / ".join(">" if value is None else f"{value:.3g}" for value in row["first_right_s"])
    squares = [row[name] for name in ("nees_fix", "nees_float", "nees_without_integers")]
    return [
        row["title"], row["hz"], str(row["epochs"]), f"{row['fix_pct']:.1f}", f"{row['right_pct']:.1f}", str(row["wrong_fixes"]),
        f"{row['wrong_pct_of_fixes']:.2f}", str(row["runs_with_wrong"]), f"{row['longest_wrong_s']:g}", first,
        *("" if means is None else " / ".join(f"{v:.2f}" for v in means) for means in squares),
    ]  # fmt: skip


def rates_of(text: str) -> list[Rates]:
    """Return the rates that a text names."""
    return [Rates(int(rover), int(base or 0)) for rover, _, base in (one.partition("/") for one in text.split(","))]


def main() -> int:
    parser = parser_of(__doc__)
    add_runs(parser, f"per family and rate (default {RUNS})", f"{QUICK_RUNS} runs of each")
    parser.add_argument("--only", default=",".join(TELLING), help="names of families, with commas between")
    parser.add_argument("--rates", default=RATES, help="rates in Hz, with commas between")
    options = parser.parse_args()
    try:
        families = named(options.only)
    except ValueError as error:
        parser.error(str(error))
    runs = options.runs or (QUICK_RUNS if options.quick else RUNS)
    rows = list(measured(families, rates_of(options.rates), runs, options.seed, options.jobs))
    print(json.dumps(rows, indent=1) if options.json else page(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
