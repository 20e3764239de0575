#!/usr/bin/env python3
"""Where is the engine wrong that no other table looks? Short simulated runs whose configurations are drawn, judged by the truth.

  modes.py [--runs N] [--seed S] [--only FACTOR=LEVEL|LEVEL,...] [--quick] [--json] [--jobs N]
  modes.py --run SEED:K [--trace]        one run again

Every run draws a level of each factor: mode, systems, frequencies, rate (10/1: the base sends once a second), receiver, ambiguities,
motion, the distance of the base, and whether this is a survey receiver or the same as the rover's; then it is as a run of the campaign
under open sky (families.py), 40 s long. Run K of a seed is the same however many there are and whatever --only asks for: this picks the
runs that have such levels (--only "mode=moving-base 2 m,systems=G|E,rate=5|10").

Tables: by each factor, by the pairs of levels that have wrong fixes in more runs than both their factors, and a command for every run with
wrong fixes. Columns as those of rates.py with bounds of 95 % confidence of the shares of fixes and of runs (the former as if fixes were
independent, which they are not). Runs whose ambiguities are "off" count for the last column alone.
"""

import argparse
import json
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from itertools import combinations, count, islice
from typing import Any, Final, NamedTuple

import numpy as np

import kernel_cache  # noqa: F401  first of all
from campaign import COLUMNS as CAMPAIGN_COLUMNS
from campaign import Outcome, cells, figures, outcome, told, trace_of
from families import BASE, MOTIONS, Random, base_place, in_motion
from results import table
from rtkmesh.rtk.options import AmbiguityMode, AmbiguityOptions, Mode, RtkOptions
from rtkmesh.simulation.classes import F9P, M8, SURVEY
from rtkmesh.simulation.receiver import ReceiverOptions
from simulated import Offset, Setup, Simulated, judge, simulate, slopes_of_two_makes_m, solve

Row = dict[str, Any]

SECONDS: Final = 40
RUNS: Final = 1000
QUICK_RUNS: Final = 150
OFF: Final = "off"
_ABOVE_M: Final = -1.5  # of both antennas of a vehicle over its origin (down)
_FAR_M: Final = 10e3
_BASE_DRIFT: Final = -1.7e-7  # s/s, of a base that is as its rover

# Levels of each factor with their weights: what costs ten times as much is drawn more seldom.
MODES: Final = {"kinematic": 0.35, "moving-base 2 m": 0.2, "moving-base 20 m": 0.1, "static": 0.2, "static-start": 0.15}
SYSTEMS: Final = {"G": 0.2, "GR": 0.2, "GE": 0.15, "E": 0.15, "C": 0.1, "GREC": 0.2}
FREQUENCIES: Final = {"1": 0.5, "2": 0.5}
RATES: Final = {"1": 0.45, "5": 0.28, "10": 0.16, "10/1": 0.08, "20": 0.03}
AMBIGUITIES: Final = {"continuous": 0.5, "fix-and-hold": 0.2, "instantaneous": 0.2, OFF: 0.1}
BASES: Final = {"survey": 0.5, "same": 0.5}
DISTANCES: Final = {"50 m to 500 m": 0.4, "500 m to 5 km": 0.4, "10 km": 0.2}
_BOUNDS_M: Final = {"50 m to 500 m": (50.0, 500.0), "500 m to 5 km": (500.0, 5e3), "10 km": (0.9 * _FAR_M, 1.1 * _FAR_M)}
_RECEIVERS: Final[Mapping[str, ReceiverOptions]] = {"F9P": F9P, "SURVEY": SURVEY, "M8": M8}
COLUMNS: Final = ("level", *CAMPAIGN_COLUMNS[1:], "NEES without integers")


class Configuration(NamedTuple):
    """The level of each factor of a run."""

    mode: str
    systems: str
    frequencies: str
    rate: str
    receiver: str
    ambiguities: str
    motion: str
    distance: str
    base: str


Only = Mapping[str, frozenset[str]]
Measured = tuple[int, Configuration, Outcome]


def _one_of(rng: Random, weights: Mapping[str, float]) -> str:
    return str(rng.choice(list(weights), p=list(weights.values())))


def drawn(rng: Random) -> Configuration:
    """Return a configuration. In the static modes the rover stands; antennas of a vehicle have the distance of the mode and one rate."""
    mode, systems, frequencies, rate = (_one_of(rng, weights) for weights in (MODES, SYSTEMS, FREQUENCIES, RATES))
    receiver, ambiguities, distance = str(rng.choice(list(_RECEIVERS))), _one_of(rng, AMBIGUITIES), _one_of(rng, DISTANCES)
    motion = "static" if mode in {Mode.STATIC, Mode.STATIC_START} else str(rng.choice(list(MOTIONS)))
    frequencies = "1" if receiver == "M8" else frequencies
    if length := _length(mode):
        return Configuration(mode, systems, frequencies, rate.partition("/")[0], receiver, ambiguities, motion, length, "same")
    return Configuration(mode, systems, frequencies, rate, receiver, ambiguities, motion, distance, _one_of(rng, BASES))


def _length(mode: str) -> str:
    """Return the distance of the antennas of a vehicle, or nothing."""
    return mode.removeprefix(Mode.MOVING_BASE).strip() if mode.startswith(Mode.MOVING_BASE) else ""


def setup_of(c: Configuration, rng: Random) -> Setup:
    """Return what is simulated of a configuration and how it is solved."""
    trajectory, multipath_s = MOTIONS[c.motion]
    like = replace(_RECEIVERS[c.receiver], systems=c.systems, frequencies=int(c.frequencies))
    rover = in_motion(like, multipath_s)
    rover_hz, _, base_hz = c.rate.partition("/")
    run = Setup(seconds=SECONDS, rate_hz=int(rover_hz), base_rate_hz=int(base_hz or 0), options=_options_of(c), trajectory=trajectory)
    run = replace(run, rover=rover, base=replace(like, clock_drift=_BASE_DRIFT))
    if length := _length(c.mode):
        arm: Offset = (-float(length.split()[0]), 0.0, _ABOVE_M)
        return replace(run, base=replace(rover, clock_drift=_BASE_DRIFT), base_moves=True, base_enu_m=arm)
    if c.base == "survey":
        run = replace(run, base=replace(BASE, signals=BASE.signals._replace(glonass_slopes_m=slopes_of_two_makes_m(rng))))
    return replace(run, base_enu_m=base_place(rng, *_BOUNDS_M[c.distance]))


def _options_of(c: Configuration) -> RtkOptions:
    mode = Mode.MOVING_BASE if _length(c.mode) else Mode(c.mode)
    ambiguity = AmbiguityOptions(mode=AmbiguityMode(c.ambiguities))
    return RtkOptions(mode=mode, systems=c.systems, frequencies=int(c.frequencies), ambiguity=ambiguity)


def _random_of(seed: int, run: int) -> Random:
    return np.random.default_rng((seed, run))


def configuration_of(seed: int, run: int) -> Configuration:
    """Return the configuration of a run."""
    return drawn(_random_of(seed, run))


def simulated_run(seed: int, run: int) -> Simulated:
    """Return a run."""
    rng = _random_of(seed, run)
    return simulate(setup_of(drawn(rng), rng), rng)


def measure(seed: int, run: int) -> Measured:
    """Simulate, solve and judge one run."""
    simulated, c = simulated_run(seed, run), configuration_of(seed, run)
    return run, c, outcome(f"{seed}:{run}", run, judge(simulated, solve(simulated)), simulated.setup.rate_hz)


def picked(seed: int, only: Only) -> Iterator[int]:
    """Yield the numbers of the runs of a seed that have the levels that are asked for."""
    for run in count():
        levels = configuration_of(seed, run)._asdict()
        if all(levels[factor] in allowed for factor, allowed in only.items()):
            yield run


def measured(seed: int, runs: int, only: Only, jobs: int) -> list[Measured]:
    """Return the outcomes of so many runs, in order."""
    with ProcessPoolExecutor(jobs) as pool:
        return list(pool.map(partial(measure, seed), islice(picked(seed, only), runs), chunksize=4))


def row_of(found: Sequence[Measured]) -> Row:
    """Return the figures of runs: those with integers, and the floats of those without."""
    fixing = [o for _, c, o in found if c.ambiguities != OFF]
    without = [o for _, c, o in found if c.ambiguities == OFF]
    row = figures(fixing) if fixing else {}
    return row | {"nees_without_integers": figures(without)["nees_float"] if without else None}


def by_factor(found: Sequence[Measured]) -> dict[str, dict[str, Row]]:
    """Return the figures of each level of each factor."""
    out: dict[str, dict[str, Row]] = {}
    for factor in Configuration._fields:
        levels = sorted({getattr(c, factor) for _, c, _ in found} - {OFF})
        out[factor] = {level: row_of([m for m in found if getattr(m[1], factor) == level]) for level in levels}
    return out


def by_pairs(found: Sequence[Measured]) -> dict[str, Row]:
    """Return the figures of the pairs of levels whose runs have wrong fixes more often than those of either level, the worst first."""
    out: dict[str, Row] = {}
    for one, other in combinations(range(len(Configuration._fields)), 2):
        for a, b in sorted({(c[one], c[other]) for _, c, o in found if o.wrong}):
            both = [m for m in found if m[1][one] == a and m[1][other] == b]
            either = max(_bad_share([m for m in found if m[1][one] == a]), _bad_share([m for m in found if m[1][other] == b]))
            if sum(o.wrong > 0 for _, _, o in both) > 1 and _bad_share(both) > either:
                out[f"{Configuration._fields[one]} {a}, {Configuration._fields[other]} {b}"] = row_of(both)
    return dict(sorted(out.items(), key=lambda item: -item[1]["runs_with_wrong_pct_95"][0]))


def _bad_share(found: Sequence[Measured]) -> float:
    """Return the share of the runs with integers that have wrong fixes."""
    bad = [o.wrong > 0 for _, c, o in found if c.ambiguities != OFF]
    return sum(bad) / max(len(bad), 1)


def replays(found: Sequence[Measured]) -> Iterator[str]:
    """Yield the command that shows each run with wrong fixes, worst first."""
    for _, c, o in sorted((m for m in found if m[2].wrong), key=lambda m: (-m[2].wrong, m[0])):
        share = f"{o.wrong:4d} wrong of {o.fixes:4d}, {o.longest_wrong_s:5.1f} s, worst {o.worst_m:6.2f} m"
        yield f"{share}: modes.py --run {o.family} --trace   {', '.join(c)}"


def page(rows: Mapping[str, Row]) -> str:
    """Return a table as Markdown."""
    return table(COLUMNS, [_cells(level, row) for level, row in rows.items()])


def _cells(level: str, row: Row) -> list[str]:
    known = cells(level, row) if "runs" in row else [level, *[""] * (len(COLUMNS) - 2)]
    return [*known, told(row["nees_without_integers"])]


def only_of(text: str) -> dict[str, frozenset[str]]:
    """Return the levels of factors that a text asks for (ValueError: there is no such factor or level)."""
    out: dict[str, frozenset[str]] = {}
    for factor, _, levels in (part.partition("=") for part in text.split(",") if part):
        out[factor] = frozenset(levels.split("|"))
        if unknown := out[factor] - levels_of(factor):
            raise ValueError(f"{factor} has no level {', '.join(sorted(unknown))}; it has {', '.join(sorted(levels_of(factor)))}")
    return out


def levels_of(factor: str) -> frozenset[str]:
    """Return the levels of a factor (ValueError: there is none of this name)."""
    lengths = [length for length in map(_length, MODES) if length]
    levels = (MODES, SYSTEMS, FREQUENCIES, RATES, _RECEIVERS, AMBIGUITIES, MOTIONS, (*DISTANCES, *lengths), BASES)
    if factor not in Configuration._fields:
        raise ValueError(f"there is no factor {factor!r}; there are {', '.join(Configuration._fields)}")
    return frozenset(levels[Configuration._fields.index(factor)])


def _report(seed: int, found: Sequence[Measured]) -> None:
    """Print the tables."""
    rows = by_factor(found)
    print(page({f"{factor} {level}": row for factor, levels in rows.items() for level, row in levels.items()} | {"all": row_of(found)}))
    if pairs := by_pairs(found):
        print(f"Pairs of levels whose runs have wrong fixes more often than those of either:\n\n{page(pairs)}")
    if commands := list(replays(found)):
        print(f"Runs with wrong fixes, seed {seed}:\n\n```text\n" + "\n".join(commands) + "\n```")


def _one(text: str, *, traced: bool) -> int:
    """Show one run: its figures, or its epochs."""
    seed, run = (int(number) for number in text.split(":"))
    print(f"{text}: " + ", ".join(f"{factor} {level}" for factor, level in configuration_of(seed, run)._asdict().items()))
    if traced:
        print("\n".join(trace_of(text, simulated_run(seed, run))))
    else:
        print(page({text: row_of([measure(seed, run)])}))
    return 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=0, help=f"in all (default {RUNS})")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="levels of factors: mode=static|static-start,systems=G")
    parser.add_argument("--run", metavar="SEED:K", help="this run alone")
    parser.add_argument("--trace", action="store_true", help="with --run: every epoch")
    parser.add_argument("--quick", action="store_true", help=f"{QUICK_RUNS} runs")
    parser.add_argument("--json", action="store_true", help="all figures, for programs")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--data", help="not needed: everything is simulated")
    options = parser.parse_args()
    if options.run:
        return _one(options.run, traced=options.trace)
    try:
        only = only_of(options.only)
    except ValueError as error:
        parser.error(str(error))
    found = measured(options.seed, options.runs or (QUICK_RUNS if options.quick else RUNS), only, options.jobs)
    if options.json:
        print(json.dumps({"seed": options.seed, "factors": by_factor(found), "pairs": by_pairs(found), "replays": list(replays(found))}))
    else:
        _report(options.seed, found)
    return 0


if __name__ == "__main__":
    sys.exit(main())
