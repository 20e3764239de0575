#!/usr/bin/env python3
"""Permanent stations tens of kilometres apart for hours, an epoch every 30 s: simulated, solved as a rover that may move.

  stations.py [--runs N] [--seed S] [--only LEVEL,...] [--quick] [--json] [--jobs N]
  stations.py --run SYSTEMS:KM:K [--seed S] [--trace]        one run again

The campaign (campaign.py) has runs of minutes at 1 Hz. What lasts shows within hours only: biases of GLONASS codes by channel between two
makes, multipath of an antenna that never moves, satellites that set with their integers and rise without, slips between epochs that are
30 s apart. Each run is a pair of survey receivers of two makes, two bands, anywhere on earth, 0.9 to 1.1 times as far apart as the level
says, six hours long; the ionosphere is from half as large as on a quiet day to one and a half times that. Columns as those of campaign.py,
the longest run of wrong fixes and the first right fix in minutes.
"""

import json
import sys
import zlib
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import product
from math import radians
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

import kernel_cache  # noqa: F401  first of all
from arguments import add_data_unused, add_runs, parser_of
from campaign import COLUMNS as CAMPAIGN_COLUMNS
from campaign import Outcome, cells, figures, lines_of, outcome
from families import Random, base_place
from results import table
from rtkmesh.gnss.ephemeris import ReferenceStation
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.options import RtkOptions
from rtkmesh.rtk.session import Session, SessionOptions, Source, pairing_for
from rtkmesh.rtk.solution import Solution
from rtkmesh.simulation.classes import SURVEY
from rtkmesh.simulation.faults import with_orbit_error
from rtkmesh.simulation.receiver import Receiver
from rtkmesh.simulation.sky import KLOBUCHAR, SATELLITES, broadcast, issues
from rtkmesh.simulation.trajectories import AntennaPath, Site
from simulated import Judged, held_against, slopes_of_two_makes_m

Row = dict[str, Any]

STEP_S: Final = 30.0
HOURS: Final = 6.0
RUNS: Final = 8  # of each level
QUICK_RUNS: Final = 1
QUICK_HOURS: Final = 1.0
SYSTEMS: Final = ("G", "GR", "GREC")
DISTANCES_KM: Final = (20, 35, 50)
_IN_MINUTES: Final = {"longest wrong s": "longest wrong min", "first right fix s": "first right fix min"}
COLUMNS: Final = ("systems, distance", *(_IN_MINUTES.get(name, name) for name in CAMPAIGN_COLUMNS[1:]))
_WEEK_S: Final = 604800
_FIRST: Final = GpsTime(2445, 0.0)
_DELAY_S: Final = 0.1  # of a base epoch behind the rover's


class Level(NamedTuple):
    """Systems, and the distance (km)."""

    systems: str
    km: int

    def __str__(self) -> str:
        return f"{self.systems}, {self.km} km"


LEVELS: Final = tuple(Level(systems, km) for systems, km in product(SYSTEMS, DISTANCES_KM))


class Stations(NamedTuple):
    """Two stations, their site's frame, and when they begin; ``seed`` is that of their errors."""

    rover: Receiver
    base: Receiver
    site: Site
    rover_ecef_m: NDArray[np.float64]
    base_ecef_m: NDArray[np.float64]
    start: GpsTime
    seed: int


def random_of(level: Level, seed: int, run: int) -> Random:
    """Return the random numbers of a run; those of all systems are alike."""
    return np.random.default_rng((seed, zlib.crc32(f"stations {level.km}".encode()), run))


def stations_of(level: Level, seed: int, run: int) -> Stations:
    """Return the stations of a run."""
    rng = random_of(level, seed, run)
    number, start = int(rng.integers(2**31)), _FIRST + STEP_S * float(rng.integers(_WEEK_S // int(STEP_S)))
    site = Site(radians(float(rng.uniform(-60.0, 60.0))), radians(float(rng.uniform(-180.0, 180.0))), float(rng.uniform(0.0, 500.0)))
    activity, place = float(rng.uniform(0.5, 1.5)), base_place(rng, 900.0 * level.km, 1100.0 * level.km)
    own = replace(SURVEY, steered=True, systems=level.systems, frequencies=2)
    other = replace(own, signals=own.signals._replace(glonass_slopes_m=slopes_of_two_makes_m(rng)))
    paths = AntennaPath(site, None, (0.0, 0.0, 0.0)), AntennaPath(site, None, place)
    rover, base = (
        Receiver(name, path, number, options, (), None, activity)
        for name, path, options in zip(("rover", "base"), paths, (own, other), strict=True)
    )
    return Stations(rover, base, site, paths[0].position_ecef_m(0.0), paths[1].position_ecef_m(0.0), start, number)


def solutions_of(level: Level, stations: Stations, epochs: int) -> Iterator[Solution | None]:
    """Yield the solution of every epoch (None: none came)."""
    options = RtkOptions(systems=level.systems, frequencies=2)
    session = Session(SessionOptions(options, pairing_for(options, replay=False)))
    x, y, z = stations.base_ecef_m.tolist()
    session.feed(Source.BASE, ReferenceStation(1, (x, y, z)), 0.0)
    session.feed(Source.NAVIGATION, KLOBUCHAR)
    known: tuple[int, int, int, int] | None = None
    for k in range(epochs):
        time, now_s = stations.start + k * STEP_S, k * STEP_S
        if (told := issues(time)) != known:
            known = told
            for satellite in SATELLITES.tolist():
                session.feed(Source.NAVIGATION, with_orbit_error(broadcast(satellite, time), stations.seed))
        session.feed(Source.ROVER, stations.rover.observe(time).epoch, now_s)
        session.feed(Source.BASE, stations.base.observe(time).epoch, now_s + _DELAY_S)
        yield next((solution for solution in session.solutions(now_s + _DELAY_S) if solution.time == time), None)


def judge(stations: Stations, solutions: Sequence[Solution | None]) -> Judged:
    """Hold solutions against the truth."""

    def compared(_: int, solution: Solution) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return solution.position_ecef_m - stations.rover_ecef_m, solution.position_cov_ecef_m2

    return held_against(compared, solutions, stations.site.ecef_from_enu(), np.ones(len(solutions), np.bool_))


def measure(level: Level, seed: int, run: int, hours: float = HOURS) -> Outcome:
    """Simulate, solve and judge one run."""
    stations = stations_of(level, seed, run)
    solutions = list(solutions_of(level, stations, round(hours * 3600.0 / STEP_S)))
    return outcome(str(level), run, judge(stations, solutions), 60.0 / STEP_S)


def measured(levels: Sequence[Level], seed: int, runs: int, hours: float, jobs: int) -> dict[str, Row]:
    """Return the figures per level, in order, from as many processes as ``jobs``."""
    work = [(level, seed, run, hours) for level in levels for run in range(runs)]
    with ProcessPoolExecutor(jobs) as pool:
        found = pool.map(measure, *zip(*work, strict=True))
        shown = track(found, "runs", len(work), console=Console(stderr=True), disable=not sys.stderr.isatty())
        outcomes = list(shown)
    return {str(level): figures([o for o in outcomes if o.family == str(level)]) for level in levels}


def page(rows: dict[str, Row]) -> str:
    """Return the table as Markdown."""
    return table(COLUMNS, [cells(title, row) for title, row in rows.items()])


def level_of(text: str) -> Level:
    """Return the level that ``SYSTEMS:KM`` names (ValueError: none)."""
    systems, _, km = text.partition(":")
    level = Level(systems, int(km) if km.isdigit() else 0)
    if level not in LEVELS:
        raise ValueError(f"there is no level {text!r}; there are {', '.join(f'{one.systems}:{one.km}' for one in LEVELS)}")
    return level


def _one(text: str, seed: int, *, traced: bool) -> int:
    """Show one run: its figures, or its epochs."""
    name, _, run = text.rpartition(":")
    level = level_of(name)
    if not traced:
        print(page({text: figures([measure(level, seed, int(run))])}))
        return 0
    stations = stations_of(level, seed, int(run))
    solutions = list(solutions_of(level, stations, round(HOURS * 3600.0 / STEP_S)))
    print("\n".join(lines_of(solutions, judge(stations, solutions))))
    return 0


def main() -> int:
    parser = parser_of(__doc__)
    add_runs(parser, f"of each level (default {RUNS})", f"{QUICK_RUNS} run of each level, {QUICK_HOURS:g} hour long")
    parser.add_argument("--only", default="", help="levels: GR:35,GR:50")
    parser.add_argument("--run", metavar="SYSTEMS:KM:K", help="this run alone")
    parser.add_argument("--trace", action="store_true", help="with --run: every epoch")
    add_data_unused(parser)
    options = parser.parse_args()
    try:
        if options.run:
            return _one(options.run, options.seed, traced=options.trace)
        levels = [level_of(name) for name in options.only.split(",") if name] or LEVELS
    except ValueError as error:
        parser.error(str(error))
    runs, hours = (QUICK_RUNS, QUICK_HOURS) if options.quick else (RUNS, HOURS)
    rows = measured(levels, options.seed, options.runs or runs, hours, options.jobs)
    print(json.dumps({"seed": options.seed, "levels": rows}) if options.json else page(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
