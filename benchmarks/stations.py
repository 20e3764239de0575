#!/usr/bin/env python3
"""Permanent stations tens of kilometres apart for hours, an epoch every 30 s: simulated, solved as a rover that may move.

  stations.py [--runs N] [--seed S] [--only LEVEL,...] [--quick] [--json] [--jobs N]
  stations.py --run LEVEL:K [--seed S] [--trace]        one run again, like GR:50:3 or GR:50:unknown:3

The campaign (campaign.py) has runs of minutes at 1 Hz. What lasts shows within hours only: biases of GLONASS codes by channel between two
makes, multipath of an antenna that never moves, satellites that set with their integers and rise without, slips between epochs that are
30 s apart. Each run is a pair of survey receivers of two makes, two bands, anywhere on earth, 0.9 to 1.1 times as far apart as the level
says, six hours long; the ionosphere is from half as large as on a quiet day to one and a half times that, waves that
travel and a slope that lasts for hours. Antennas are calibrated, as those
of stations are, but for the levels that say otherwise. RTKLIB is given the same observations and ephemerides as RINEX, if it is installed.
Columns as those of campaign.py, the longest run of wrong fixes and the first right fix in minutes.
"""

import json
import sys
import tempfile
import zlib
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from itertools import product
from math import radians
from pathlib import Path
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
from peers import OURS
from results import table
from rtkmesh.gnss.ephemeris import Ephemeris, ReferenceStation
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.time import GpsTime
from rtkmesh.models.antenna import find_antenna
from rtkmesh.rtk.options import RtkOptions
from rtkmesh.rtk.session import Session, SessionOptions, Source, pairing_for
from rtkmesh.rtk.solution import Solution
from rtkmesh.simulation.classes import SURVEY
from rtkmesh.simulation.faults import with_orbit_error
from rtkmesh.simulation.receiver import Receiver
from rtkmesh.simulation.sky import KLOBUCHAR, SATELLITES, broadcast, issues
from rtkmesh.simulation.trajectories import AntennaPath, Site
from score_pos import Track
from simulated import Judged, held_against, slopes_of_two_makes_m
from simulated_files import epochs_of
from station_peers import station_peers, written

Row = dict[str, Any]

STEP_S: Final = 30.0
HOURS: Final = 6.0
RUNS: Final = 8  # of each level
QUICK_RUNS: Final = 1
QUICK_HOURS: Final = 1.0
SYSTEMS: Final = ("G", "GR", "GREC")
DISTANCES_KM: Final = (20, 35, 50)
_IN_MINUTES: Final = {"longest wrong s": "longest wrong min", "first right fix s": "first right fix min"}
COLUMNS: Final = ("systems, distance", "solved by", *(_IN_MINUTES.get(name, name) for name in CAMPAIGN_COLUMNS[1:]))
_ANTENNA: Final = "ADVNULLANTENNA"  # calibrated, with all phase centres in its reference point
SLOPE_PPM: Final = 0.4  # of the ionosphere for hours, on a quiet day
_WEEK_S: Final = 604800
_FIRST: Final = GpsTime(2445, 0.0)
_DELAY_S: Final = 0.1  # of a base epoch behind the rover's


class Level(NamedTuple):
    """Systems, the distance (km), and whether the solver knows the antennas of both ends."""

    systems: str
    km: int
    calibrated: bool = True

    def __str__(self) -> str:
        return f"{self.systems}, {self.km} km{'' if self.calibrated else ', antennas unknown'}"

    @property
    def name(self) -> str:
        """How it is asked for."""
        return f"{self.systems}:{self.km}{'' if self.calibrated else ':unknown'}"


LEVELS: Final = (*(Level(*one) for one in product(SYSTEMS, DISTANCES_KM)), *(Level("GR", km, False) for km in DISTANCES_KM))


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
        Receiver(name, path, number, options, (), None, activity, slope_ppm=SLOPE_PPM * activity)
        for name, path, options in zip(("rover", "base"), paths, (own, other), strict=True)
    )
    return Stations(rover, base, site, paths[0].position_ecef_m(0.0), paths[1].position_ecef_m(0.0), start, number)


class Seen(NamedTuple):
    """What there is at an epoch: ephemerides if there are new ones, and what both receivers observe."""

    ephemerides: list[Ephemeris]
    rover: Epoch
    base: Epoch


def seen_by(stations: Stations, epochs: int) -> Iterator[Seen]:
    """Yield what there is, epoch by epoch."""
    known: tuple[int, int, int, int] | None = None
    for k in range(epochs):
        time = stations.start + k * STEP_S
        new: list[Ephemeris] = []
        if (told := issues(time)) != known:
            known, new = told, [with_orbit_error(broadcast(satellite, time), stations.seed) for satellite in SATELLITES.tolist()]
        yield Seen(new, stations.rover.observe(time).epoch, stations.base.observe(time).epoch)


def solutions_of(level: Level, stations: Stations, seen: Iterable[Seen]) -> Iterator[Solution | None]:
    """Yield the solution of every epoch (None: none came)."""
    options = RtkOptions(systems=level.systems, frequencies=2)
    antenna = _ANTENNA if level.calibrated else ""
    session = Session(SessionOptions(
        options, pairing_for(options, replay=False), rover_antenna=antenna, base_antenna=antenna, find_antenna=partial(find_antenna, ()),
    ))  # fmt: skip
    x, y, z = stations.base_ecef_m.tolist()
    session.feed(Source.BASE, ReferenceStation(1, (x, y, z)), 0.0)
    session.feed(Source.NAVIGATION, KLOBUCHAR)
    for k, (ephemerides, rover, base) in enumerate(seen):
        now_s = k * STEP_S
        for ephemeris in ephemerides:
            session.feed(Source.NAVIGATION, ephemeris)
        session.feed(Source.ROVER, rover, now_s)
        session.feed(Source.BASE, base, now_s + _DELAY_S)
        yield next((solution for solution in session.solutions(now_s + _DELAY_S) if solution.time == rover.time), None)


def judge(stations: Stations, solutions: Sequence[Solution | None]) -> Judged:
    """Hold solutions against the truth."""

    def compared(_: int, solution: Solution) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return solution.position_ecef_m - stations.rover_ecef_m, solution.position_cov_ecef_m2

    return held_against(compared, solutions, stations.site.ecef_from_enu(), np.ones(len(solutions), np.bool_))


def judge_track(stations: Stations, epochs: int, track: Track | None) -> Judged:
    """Hold the solutions of another program against the truth."""
    judged = judge(stations, [None] * epochs)
    if track is not None:
        k = epochs_of(stations.start, 1.0 / STEP_S, track)
        inside = (k >= 0) & (k < epochs)
        judged.status[k[inside]] = track.quality[inside]
        judged.error_enu_m[k[inside]] = (track.vector_m[inside] - stations.rover_ecef_m) @ stations.site.ecef_from_enu()
    return judged


def measure(level: Level, seed: int, run: int, hours: float = HOURS) -> dict[str, Outcome]:
    """Simulate one run, have it solved by us and, where antennas make no difference, by RTKLIB, and judge it."""
    stations = stations_of(level, seed, run)
    seen = list(seen_by(stations, round(hours * 3600.0 / STEP_S)))
    judged = {OURS: judge(stations, list(solutions_of(level, stations, seen)))}
    if level.calibrated:
        with tempfile.TemporaryDirectory() as folder:
            ephemerides = (ephemeris for one in seen for ephemeris in one.ephemerides)
            files = written([one.rover for one in seen], [one.base for one in seen], ephemerides, Path(folder))
            for peer in station_peers():
                found = peer.solve(files, level.systems, stations.base_ecef_m.tolist(), stations.start, hours * 3600.0)
                judged[peer.name] = judge_track(stations, len(seen), found)
    return {solver: outcome(level.name, run, one, 60.0 / STEP_S) for solver, one in judged.items()}


def measured(levels: Sequence[Level], seed: int, runs: int, hours: float, jobs: int) -> list[Row]:
    """Return the figures per level and solver, in order, from as many processes as ``jobs``."""
    work = [(level, seed, run, hours) for level in levels for run in range(runs)]
    with ProcessPoolExecutor(jobs) as pool:
        found = pool.map(measure, *zip(*work, strict=True))
        shown = track(found, "runs", len(work), console=Console(stderr=True), disable=not sys.stderr.isatty())
        outcomes = list(shown)
    return [row for level in levels for row in rows_of(level, [one for one in outcomes if one[OURS].family == level.name])]


def rows_of(level: Level, found: Sequence[dict[str, Outcome]]) -> list[Row]:
    """Return the figures of runs of a level, per solver."""
    return [{"level": str(level), "solver": solver} | figures([one[solver] for one in found]) for solver in found[0]]


def page(rows: Sequence[Row]) -> str:
    """Return the table as Markdown."""
    return table(COLUMNS, [[row["level"], *cells(row["solver"], row)] for row in rows])


def level_of(text: str) -> Level:
    """Return the level of a name (ValueError: none)."""
    for level in LEVELS:
        if level.name == text:
            return level
    raise ValueError(f"there is no level {text!r}; there are {', '.join(one.name for one in LEVELS)}")


def _one(text: str, seed: int, *, traced: bool) -> int:
    """Show one run: its figures, or its epochs."""
    name, _, run = text.rpartition(":")
    level = level_of(name)
    if not traced:
        print(page(rows_of(level, [measure(level, seed, int(run))])))
        return 0
    stations = stations_of(level, seed, int(run))
    solutions = list(solutions_of(level, stations, seen_by(stations, round(HOURS * 3600.0 / STEP_S))))
    print("\n".join(lines_of(solutions, judge(stations, solutions))))
    return 0


def main() -> int:
    parser = parser_of(__doc__)
    add_runs(parser, f"of each level (default {RUNS})", f"{QUICK_RUNS} run of each level, {QUICK_HOURS:g} hour long")
    parser.add_argument("--only", default="", help="levels: GR:35,GR:50")
    parser.add_argument("--run", metavar="LEVEL:K", help="this run alone")
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
