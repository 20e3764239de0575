#!/usr/bin/env python3
"""Which cycle slips are found, and what the others do: slips that nobody tells (and some that receivers tell) put into clean phases.

  slips.py [--data DIR] [--only SCENE,...] [--quick] [--json] [--seed S]

Phases are those of recordings and of simulated receivers that do not slip by themselves. The same epochs are solved once as they are and
once with slips, every few epochs on other satellites, and the second run is held against the first:

found: the ambiguity was moved or begun anew in the epoch of the slip; later: within the three epochs after it (the screened update);
missed: neither. false: ambiguities that were moved or begun anew without a slip, per thousand epochs, beyond those of the run without
slips. lost: fixes (in % of those without slips) that the slips cost; wrong: fixes that are off by more than 0.15 m from those without.
"""

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import radians
from pathlib import Path
from typing import Any, Final

import numpy as np

import kernel_cache  # noqa: F401  first of all
from cases import Case, data_folder, load
from results import table
from rtkmesh.gnss.epoch import SLIP, Epoch
from rtkmesh.gnss.signals import GLONASS, SATELLITES_PER_SYSTEM, carrier_hz
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.options import RtkOptions
from rtkmesh.rtk.session import EndOfStream, Input, Session, SessionOptions, Source, pairing_for
from rtkmesh.rtk.solution import USED_PHASE, Solution, Status
from rtkmesh.simulation.classes import F9P, SURVEY
from rtkmesh.simulation.receiver import Receiver, ReceiverOptions
from rtkmesh.simulation.sky import KLOBUCHAR, SATELLITES, broadcast
from rtkmesh.simulation.trajectories import AntennaPath, Site, Trajectory, driving, static
from rtkmesh_services.cli.offline import open_inputs
from simulated import WRONG_M

Random = np.random.Generator
Row = dict[str, Any]

_SETTLED: Final = 15  # epochs before the first slip
_APART: Final = 12  # epochs from slip to slip
_LATE: Final = 3
_SITE: Final = Site(radians(47.0), radians(8.0), 400.0)
_BASE_ENU_M: Final = (-320.0, 210.0, 4.0)
COLUMNS: Final = ("scene", "fault", "slips", "found", "later", "missed", "false / 1000", "fix % without", "lost %", "wrong")


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Clean phases and how they are solved. ``others`` are messages beside epochs, each with its stream."""

    name: str
    rover: list[Epoch]
    base: list[Epoch]
    others: list[tuple[Source, Input]]
    options: RtkOptions
    base_ecef_m: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Fault:
    """What is done to phases.

    ``cycles`` are the slips of a satellite's bands, the highest frequency first (0: none; with one band the first that is not 0);
    ``share`` of the satellites slips at once (0: one satellite), with random signs. ``gap_s`` is how long the rover's epochs are lost
    before the slip, or with ``one_gap`` those of the satellite alone. ``told``: the receiver says so (and the size is random).
    """

    name: str
    cycles: tuple[float, float] = (0.0, 0.0)
    share: float = 0.0
    gap_s: float = 0.0
    one_gap: bool = False
    told: bool = False


FAULTS: Final = (
    Fault("one band, 1", (1.0, 0.0)),
    Fault("second band, 1", (0.0, 1.0)),
    Fault("both bands, 1", (1.0, 1.0)),
    Fault("both bands, 9 and 7", (9.0, 7.0)),
    Fault("both bands, 4 and 3", (4.0, 3.0)),
    Fault("both bands, 5 and 4", (5.0, 4.0)),
    Fault("one band, a half", (0.5, 0.0)),
    Fault("both bands, a half", (0.5, 0.5)),
    Fault("half of the satellites, one band, 1", (1.0, 0.0), 0.5),
    Fault("half of the satellites, both bands, 1", (1.0, 1.0), 0.5),
    Fault("gap of 1 s, 1", (1.0, 0.0), gap_s=1.0),
    Fault("gap of 5 s, 1", (1.0, 0.0), gap_s=5.0),
    Fault("gap of 15 s, 1", (1.0, 0.0), gap_s=15.0),
    Fault("gap of 5 s, a third, both bands, 1", (1.0, 1.0), 0.33, 5.0),
    Fault("satellite away for 1 s, 1", (1.0, 0.0), gap_s=1.0, one_gap=True),
    Fault("satellite away for 5 s, 1", (1.0, 0.0), gap_s=5.0, one_gap=True),
    Fault("satellite away for 5 s, both, 1", (1.0, 1.0), gap_s=5.0, one_gap=True),
    Fault("told, one band", (1.0, 0.0), told=True),
    Fault("told, a third, both bands", (1.0, 1.0), 0.33, told=True),
)


# --- scenes ---


def recorded(name: str, case: Case, stride: int = 1, most: int = 1200) -> Scene:
    """Return the scene of a recorded pair; every ``stride``-th epoch of the rover, so many at most."""
    date = GpsTime.from_calendar(*(int(part) for part in case.date.split("-")), 12) if case.date else None
    inputs = open_inputs(case.rover, case.base, case.navigation, date)
    assert inputs.base is not None
    others: list[tuple[Source, Input]] = []
    epochs: dict[Source, list[Epoch]] = {Source.ROVER: [], Source.BASE: []}
    streams = [(Source.NAVIGATION, file) for file in inputs.navigation] + [(Source.BASE, inputs.base), (Source.ROVER, inputs.rover)]
    for source, recording in streams:
        for message in recording.messages():
            if isinstance(message, Epoch):
                epochs[source].append(message)
            elif not isinstance(message, EndOfStream):
                others.append((Source.NAVIGATION, message))
    options = RtkOptions(frequencies=case.frequencies, systems=case.systems)
    rover = epochs[Source.ROVER][::stride][:most]
    return Scene(name, rover, epochs[Source.BASE], others, options, case.base_ecef_m)


def imagined(name: str, trajectory: Trajectory, receiver: ReceiverOptions, interval_s: float, count: int, frequencies: int = 2) -> Scene:
    """Return a simulated scene 400 m from its base, without slips of its own."""
    start = GpsTime(2445, 100000.0)
    rover = replace(receiver, signals=receiver.signals._replace(slips_per_hour=0.0, half_cycle_share=0.0), frequencies=frequencies)
    base = replace(SURVEY, steered=True, signals=SURVEY.signals._replace(slips_per_hour=0.0))
    moving = Receiver("rover", AntennaPath(_SITE, trajectory, (0.0, 0.0, -1.5)), 5, rover)
    standing = Receiver("base", AntennaPath(_SITE, None, _BASE_ENU_M), 5, base)
    tags = [start + k * interval_s for k in range(count)]
    others: list[tuple[Source, Input]] = [(Source.NAVIGATION, broadcast(s, start)) for s in SATELLITES.tolist()]
    others.append((Source.NAVIGATION, KLOBUCHAR))
    seen = [standing.observe(tag) for tag in tags]
    x, y, z = seen[0].position_ecef_m.tolist()
    epochs = [moving.observe(tag).epoch for tag in tags]
    return Scene(name, epochs, [o.epoch for o in seen], others, RtkOptions(frequencies=frequencies), (x, y, z))


def fewer(scene: Scene, count: int) -> Scene:
    """Return the scene with the satellites alone that are there most of the time, highest first (by their C/N0)."""
    best: dict[int, float] = {}
    for epoch in scene.rover:
        for satellite in np.unique(epoch.satellite).tolist():
            rows = (epoch.satellite == satellite) & np.isfinite(epoch.phase_cyc)
            bands = len(np.unique(epoch.signal[rows] // 26))
            if satellite // SATELLITES_PER_SYSTEM != GLONASS and bands >= min(scene.options.frequencies, 2):
                best[satellite] = best.get(satellite, 0.0) + float(np.nanmean(epoch.cn0_dbhz[rows]))
    systems = [s // SATELLITES_PER_SYSTEM for s in best]
    ranked = sorted((s for s in best if s // SATELLITES_PER_SYSTEM == max(systems, key=systems.count)), key=lambda s: -best[s])[:count]
    rover = [epoch.take(np.isin(epoch.satellite, ranked)) for epoch in scene.rover]
    return replace(scene, name=f"{scene.name}, {count} satellites", rover=rover)


# --- slips ---


@dataclass(frozen=True, slots=True)
class Slip:
    """A jump of one phase at an epoch (index among the rover's)."""

    at: int
    satellite: int
    signal: int
    cycles: float


def solve(scene: Scene, rover: Sequence[Epoch]) -> dict[GpsTime, Solution]:
    """Return the solutions of a scene with other rover epochs, by time."""
    pairing = pairing_for(scene.options, replay=True)
    session = Session(SessionOptions(scene.options, pairing, scene.base_ecef_m, navigation_streams=1))
    for source, message in scene.others:
        session.feed(source, message)
    session.feed(Source.NAVIGATION, EndOfStream())
    out: dict[GpsTime, Solution] = {}
    bases = iter(scene.base)
    waiting = next(bases, None)
    for epoch in rover:
        session.feed(Source.ROVER, epoch)
        while waiting is not None and waiting.time - epoch.time < 1.0:
            session.feed(Source.BASE, waiting)
            waiting = next(bases, None)
        out |= {solution.time: solution for solution in session.solutions()}
    session.feed(Source.BASE, EndOfStream())
    session.feed(Source.ROVER, EndOfStream())
    return out | {solution.time: solution for solution in session.solutions()}


def _tracked(solution: Solution | None, age_s: float) -> dict[int, list[int]]:
    """Return the signals per satellite, highest frequency first, whose phases serve for so long already."""
    found: dict[int, list[int]] = {}
    if solution is None:
        return found
    t = solution.satellites
    for satellite, signal, state, age in zip(t.satellite.tolist(), t.signal.tolist(), t.state.tolist(), t.lock_s.tolist(), strict=True):
        if state & USED_PHASE and age >= age_s:
            found.setdefault(satellite, []).append(signal)
    return {s: sorted(signals, key=lambda signal: -carrier_hz(s, signal, 0)) for s, signals in found.items()}


def usual_interval_s(scene: Scene) -> float:
    """Return the usual time from epoch to epoch of the rover."""
    return float(np.median([b.time - a.time for a, b in pairwise(scene.rover)]))


def put(scene: Scene, fault: Fault, clean: dict[GpsTime, Solution], rng: Random) -> tuple[list[Epoch], list[Slip]]:
    """Return the rover's epochs with slips, and these."""
    interval_s = usual_interval_s(scene)
    missing = round(fault.gap_s / interval_s)
    slips: list[Slip] = []
    dropped: set[int] = set()
    hidden: dict[int, int] = {}
    for at in range(_SETTLED + missing, len(scene.rover) - _LATE, _APART + missing):
        before = _tracked(clean.get(scene.rover[at - 1 - missing].time), 3.0 * interval_s)
        after = _tracked(clean.get(scene.rover[at].time), (3.0 + missing) * interval_s)
        both = sorted(set(before) & set(after))
        if len(both) < 2:
            continue
        count = max(1, round(fault.share * len(both))) if fault.share else 1
        chosen = rng.choice(both, count, replace=False).tolist()
        for satellite in chosen:
            sign = 1.0 if rng.random() < 0.5 else -1.0
            bands = [s for s in after[satellite] if s in before[satellite]]
            sizes = fault.cycles if scene.options.frequencies > 1 else (max(fault.cycles, key=bool),)
            for signal, cycles in zip(bands, sizes, strict=False):
                size = float(rng.integers(1, 30)) if fault.told else cycles
                if cycles:
                    slips.append(Slip(at, satellite, signal, sign * size))
            if fault.one_gap:
                hidden |= dict.fromkeys(range(at - missing, at), satellite)
        if missing and not fault.one_gap:
            dropped |= set(range(at - missing, at))
    return list(_slipped(scene.rover, slips, dropped, hidden, fault.told)), slips


def _slipped(rover: Sequence[Epoch], slips: Sequence[Slip], dropped: set[int], hidden: dict[int, int], told: bool) -> Iterator[Epoch]:
    """Yield the epochs that are left, every slip from its own on."""
    total: dict[tuple[int, int], float] = {}
    for k, epoch in enumerate(rover):
        now = {(s.satellite, s.signal): s.cycles for s in slips if s.at == k}
        for key, cycles in now.items():
            total[key] = total.get(key, 0.0) + cycles
        if k in dropped:
            continue
        rows = list(zip(epoch.satellite.tolist(), epoch.signal.tolist(), strict=True))
        phase = epoch.phase_cyc + np.array([total.get(row, 0.0) for row in rows])
        flags = epoch.flags | np.array([SLIP if told and row in now else 0 for row in rows], np.uint8)
        changed = replace(epoch, phase_cyc=phase, flags=flags)
        yield changed.take(epoch.satellite != hidden[k]) if k in hidden else changed


# --- scores ---


def _states(solution: Solution | None) -> dict[tuple[int, int], tuple[int, float]]:
    """Return slips and arc age per (satellite, signal)."""
    if solution is None:
        return {}
    t = solution.satellites
    rows = zip(t.satellite.tolist(), t.signal.tolist(), t.slips.tolist(), t.lock_s.tolist(), strict=True)
    return {(satellite, signal): (slips, age) for satellite, signal, slips, age in rows if np.isfinite(age)}


def renewed(rover: Sequence[Epoch], solutions: dict[GpsTime, Solution]) -> set[tuple[GpsTime, int, int]]:
    """Return when which ambiguity was moved or begun anew: its slips were counted, or its arc is younger than it should be."""
    found: set[tuple[GpsTime, int, int]] = set()
    known: dict[tuple[int, int], tuple[int, float, GpsTime]] = {}
    for epoch in rover:
        for key, (slips, age_s) in _states(solutions.get(epoch.time)).items():
            before = known.get(key)
            if age_s == 0.0 or (before is not None and (slips != before[0] or age_s < before[1] + 0.5 * (epoch.time - before[2]))):
                found.add((epoch.time, *key))
            known[key] = slips, age_s, epoch.time
    return found


def judge(scene: Scene, rover: Sequence[Epoch], slips: Sequence[Slip], clean: dict[GpsTime, Solution]) -> Row:
    """Return what became of the slips."""
    solutions = solve(scene, rover)
    times = [epoch.time for epoch in rover]
    place = {time: k for k, time in enumerate(times)}
    events, usual = renewed(rover, solutions), renewed(scene.rover, clean)
    found = later = 0
    explained: set[tuple[GpsTime, int, int]] = set()
    for slip in slips:
        first = place[scene.rover[slip.at].time]
        hits = [(time, slip.satellite, slip.signal) in events for time in times[first : first + 1 + _LATE]]
        explained |= {(time, slip.satellite, slip.signal) for time in times[first : first + 1 + _LATE]}
        found += hits[0]
        later += not hits[0] and any(hits)
    fixed = [t for t in times if t in clean and clean[t].status is Status.FIX]
    kept = [t for t in fixed if t in solutions and solutions[t].status is Status.FIX]
    wrong = sum(bool(np.linalg.norm(solutions[t].position_ecef_m - clean[t].position_ecef_m) > WRONG_M) for t in kept)
    return {
        "scene": scene.name, "slips": len(slips), "found": found, "later": later, "missed": len(slips) - found - later,
        "false": 1000.0 * len(events - explained - usual) / max(len(times), 1), "fix_pct": 100.0 * len(fixed) / max(len(times), 1),
        "lost_pct": 100.0 * (1.0 - len(kept) / len(fixed)) if fixed else 0.0, "wrong": wrong,
    }  # fmt: skip


def measure(scene: Scene, faults: Sequence[Fault], seed: int) -> Iterator[Row]:
    """Yield a row per fault that the scene can have."""
    clean = solve(scene, scene.rover)
    for number, fault in enumerate(faults):
        one_band = scene.options.frequencies == 1
        repeats = one_band and (fault.cycles[0] != 1.0 or fault.cycles[1] or fault.share) and fault.cycles != (0.5, 0.0)
        if repeats and not (fault.share and not fault.cycles[1]):
            continue
        if 0.0 < fault.gap_s < usual_interval_s(scene):
            continue
        rover, slips = put(scene, fault, clean, np.random.default_rng((seed, number)))
        yield {"fault": fault.name} | judge(scene, rover, slips, clean)


def scenes(data: Path | None) -> dict[str, Callable[[], Scene]]:
    """Return the makers of all scenes by name."""
    found: dict[str, Callable[[], Scene]] = {
        "drive": lambda: imagined("drive, F9P, 1 Hz", driving, F9P, 1.0, 300),
        "drive_l1": lambda: imagined("drive, F9P, one band, 1 Hz", driving, F9P, 1.0, 300, 1),
        "drive_10hz": lambda: imagined("drive, F9P, 10 Hz", driving, F9P, 0.1, 400),
        "static_30s": lambda: imagined("static, F9P, 30 s", static, F9P, 30.0, 240),
        "static_15s_l1": lambda: imagined("static, F9P, one band, 15 s", static, F9P, 15.0, 240, 1),
        "drive_5": lambda: fewer(imagined("drive, F9P, 1 Hz", driving, F9P, 1.0, 300), 5),
    }
    if data is None:
        return found
    cases = {case.name: case for case in load(data)}
    return found | {
        "tokyo": lambda: recorded("tokyo, 1 Hz", replace(cases["tokyo_static_l125"], frequencies=2)),
        "tokyo_l1gps": lambda: recorded("tokyo, GPS on one band, 1 Hz", cases["tokyo_static_l1gps"]),
        "tokyo_5": lambda: fewer(recorded("tokyo, 1 Hz", replace(cases["tokyo_static_l125"], frequencies=2)), 5),
        "tokyo_4": lambda: fewer(recorded("tokyo, 1 Hz", replace(cases["tokyo_static_l125"], frequencies=2)), 4),
        "stromlo": lambda: recorded("stromlo, 1 Hz", cases["stromlo_l12"], most=600),
        "stromlo_l1": lambda: recorded("stromlo, one band, 1 Hz", replace(cases["stromlo_l12"], frequencies=1), most=600),
        "geonet_30s": lambda: recorded("geonet, 30 s", cases["geonet_2005"]),
        "stromlo_15s": lambda: recorded("stromlo, 15 s", cases["stromlo_l12"], 15),
        "galway": lambda: recorded("galway, M8P, one band, 1 Hz", cases["galway_a"], most=600),
        "galway_walk": lambda: recorded("galway, M8P on a walk, one band, 1 Hz", cases["galway_b_walk"], most=600),
    }


QUICK: Final = ("drive", "tokyo_l1gps", "tokyo_5")


def page(rows: Sequence[Row]) -> str:
    """Return the table as Markdown."""
    return table(COLUMNS, [
        [
            row["scene"], row["fault"], *(str(row[name]) for name in ("slips", "found", "later", "missed")), f"{row['false']:.1f}",
            f"{row['fix_pct']:.0f}", f"{row['lost_pct']:.1f}", str(row["wrong"]),
        ]
        for row in rows
    ])  # fmt: skip


def main() -> int:
    options = _options()
    makers = scenes(options.data or data_folder())
    chosen = options.only.split(",") if options.only else [name for name in makers if not options.quick or name in QUICK]
    rows = [row for name in chosen for row in measure(makers[name](), FAULTS, options.seed)]
    print(json.dumps(rows, indent=1) if options.json else page(rows))
    return 0


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of the recordings (default RTKMESH_DATA or ../shared/data)")
    parser.add_argument("--only", help="names of scenes, with commas between")
    parser.add_argument("--quick", action="store_true", help=f"{len(QUICK)} scenes")
    parser.add_argument("--json", action="store_true", help="all figures, for programs")
    parser.add_argument("--seed", type=int, default=1)
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
