#!/usr/bin/env python3
"""After a dive: how soon a right fix, and how many false ones (the experiment of figure 6 of the rtkrcv_ros paper, simulated).

  dive.py [--dives N] [--seed S] [--quick] [--json]

A boat dives with its antenna for 10 to 120 s again and again, and stays 45 s on the surface; for the first 8 s waves hide what stands
below 25 degrees. The base is a kilometre away. The simulated receivers' bytes (UBX and RTCM 3) go through our decoders and a live session,
and through convbin and RTKLIB's rnx2rtkp. `restarted`: the solver is stopped and started at every surfacing, which is what the paper's
command path does against false fixes; for rnx2rtkp that is a run of its own per surfacing. Time to first right fix counts from the first
epoch with five satellites (s, 50 % / 95 %, '>' when so many never had one); a fix is false when it is off by more than 0.15 m in 3D.
"""

import argparse
import json
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import radians
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

import kernel_cache  # noqa: F401  first of all
import rtklib
from bounds import clopper_pearson
from results import table
from rtkmesh.codecs.stream import StreamDecoder, StreamOptions
from rtkmesh.rtk.options import RtkOptions
from rtkmesh.rtk.session import Session, SessionOptions, Source, pairing_for
from rtkmesh.rtk.solution import Status
from rtkmesh.simulation.classes import F9P, M8, SURVEY, moving
from rtkmesh.simulation.receiver import ReceiverOptions
from rtkmesh.simulation.trajectories import boat
from score_pos import FIX, Track
from simulated import ENOUGH_SATELLITES, WRONG_M, Outage, Setup, Simulated, simulate, slopes_of_two_makes_m
from simulated_files import Files, Sent, by_rnx2rtkp, converted, epochs_of, sent

Row = dict[str, Any]
Errors = NDArray[np.float64]  # per epoch: 3D error of a fix (m), NaN without a fix

DIVES: Final = 60
QUICK_DIVES: Final = 12
COLUMNS: Final = (
    "receiver", "solved by", "surfacings", "first right fix s", "never fixed", "right %", "false fixes", "surfacings with false % (95 %)",
)  # fmt: skip
_SURFACE_S: Final = 45
_WAVES_S: Final = 8.0
_WAVES_BELOW_RAD: Final = radians(25.0)
_DIVE_LENGTHS_S: Final = (10, 20, 40, 80, 120)  # one mission has each once, in an order of its own
_RECEIVERS: Final = {
    "F9P class, two bands, GREC": (F9P, 2, "GREC"),
    "M8 class, one band, GR": (M8, 1, "GR"),
}


@dataclass(frozen=True, slots=True, eq=False)
class Mission:
    """A mission as bytes; ``surfacings`` are the (first, last + 1) epochs between the dives."""

    run: Simulated
    sent: Sent
    surfacings: list[tuple[int, int]]


def mission(receiver: ReceiverOptions, frequencies: int, rng: np.random.Generator) -> Mission:
    """Return a mission of as many dives as there are lengths."""
    outages, surfacings, at = list[Outage](), list[tuple[int, int]](), _SURFACE_S
    for length in rng.permutation(_DIVE_LENGTHS_S).tolist():
        outages += [Outage(float(at), float(length)), Outage(float(at + length), _WAVES_S, _WAVES_BELOW_RAD)]
        surfacings.append((at + length, at + length + _SURFACE_S))
        at += length + _SURFACE_S
    signals = SURVEY.signals._replace(glonass_slopes_m=slopes_of_two_makes_m(rng))
    base = replace(SURVEY, steered=True, signals=signals)
    setup = Setup(
        seconds=at, options=RtkOptions(frequencies=frequencies), trajectory=boat,
        rover=replace(receiver, signals=moving(receiver.signals, 15.0)), base=base, base_enu_m=(800.0, -600.0, 5.0),
        outages=tuple(outages),
    )  # fmt: skip
    run = simulate(setup, rng)
    return Mission(run, sent(run), surfacings)


def ours(mission: Mission, *, restarted: bool) -> Errors:
    """Return the errors of our fixes on the bytes."""
    run, options = mission.run, mission.run.setup.options
    session = Session(SessionOptions(options, pairing_for(options, replay=False)))
    decoders = {source: StreamDecoder(StreamOptions(approximate_time=run.start)) for source in (Source.ROVER, Source.BASE)}
    starts = {first for first, _ in mission.surfacings} if restarted else set[int]()
    errors = np.full(run.setup.epochs, np.nan)
    for k in range(run.setup.epochs):
        if k in starts:
            session.restart()
        for source, data in ((Source.ROVER, mission.sent.rover[k]), (Source.BASE, mission.sent.base[k])):
            for _, messages in decoders[source].feed(data):
                for message in messages:
                    session.feed(source, message, float(k))
        for solution in session.solutions(k + 0.5):
            if solution.status is Status.FIX:
                _note(errors, run, round(solution.time - run.start), solution.position_ecef_m)
    return errors


def _note(errors: Errors, run: Simulated, k: int, position_ecef_m: NDArray[np.float64]) -> None:
    if 0 <= k < len(errors):
        errors[k] = np.linalg.norm(position_ecef_m - run.rover[k].position_ecef_m)


def theirs(mission: Mission, files: Files, systems: str, ambiguities: str, *, restarted: bool) -> Errors:
    """Return the errors of rnx2rtkp's fixes."""
    run = mission.run
    plain = rtklib.plain_options("kinematic", systems, run.setup.options.frequencies, ambiguities)
    options = plain + rtklib.base_options(run.base_ecef_m.tolist())
    errors = np.full(run.setup.epochs, np.nan)
    for span in mission.surfacings if restarted else [(0, run.setup.epochs)]:
        found = by_rnx2rtkp(run.start, files, options, span)
        if found is not None:
            _note_fixes(errors, run, found)
    return errors


def _note_fixes(errors: Errors, run: Simulated, found: Track) -> None:
    fixed, places = found.quality == FIX, epochs_of(run.start, run.setup.rate_hz, found)
    for k, position_m in zip(places[fixed], found.vector_m[fixed], strict=True):
        _note(errors, run, int(k), position_m)


@dataclass(frozen=True, slots=True)
class Surfacing:
    """What happened between two dives."""

    epochs: int
    right: int
    false: int
    first_right_s: float  # inf: never


def surfacings(mission: Mission, errors: Errors) -> Iterator[Surfacing]:
    """Yield what happened after each dive, from the first epoch with enough satellites on."""
    for first, last in mission.surfacings:
        tracked = [len(np.unique(o.epoch.satellite)) >= ENOUGH_SATELLITES for o in mission.run.rover[first:last]]
        begin = first + int(np.argmax(tracked))
        part = errors[begin:last]
        right = np.flatnonzero(part <= WRONG_M)
        yield Surfacing(len(part), len(right), int(np.sum(part > WRONG_M)), float(right[0]) if len(right) else float("inf"))


def figures(found: Sequence[Surfacing]) -> Row:
    """Return the figures of many surfacings."""
    first = np.sort([s.first_right_s for s in found])
    bad = sum(s.false > 0 for s in found)
    return {
        "surfacings": len(found),
        "first_right_s": [float(v) if np.isfinite(v) else None for v in (first[len(first) // 2], first[int(0.95 * len(first))])],
        "never_fixed": int(np.sum(~np.isfinite(first))),
        "right_pct": 100.0 * sum(s.right for s in found) / sum(s.epochs for s in found),
        "false_fixes": sum(s.false for s in found),
        "surfacings_with_false_pct": 100.0 * bad / len(found),
        "surfacings_with_false_pct_95": [100.0 * bound for bound in clopper_pearson(bad, len(found))],
    }


def solved(mission: Mission, systems: str) -> Iterator[tuple[str, list[Surfacing]]]:
    """Yield what every solver makes of a mission, under its name."""
    for restarted, word in ((False, ""), (True, ", restarted")):
        yield f"rtkmesh{word}", list(surfacings(mission, ours(mission, restarted=restarted)))
    if rtklib.missing():
        return
    with tempfile.TemporaryDirectory() as folder:
        files = converted(mission.run, mission.sent, Path(folder))
        for ambiguities in ("continuous", "fix-and-hold"):
            for restarted, word in ((False, ""), (True, ", restarted")):
                errors = theirs(mission, files, systems, ambiguities, restarted=restarted)
                yield f"RTKLIB b34 {ambiguities}{word}", list(surfacings(mission, errors))


def measured(dives: int, seed: int) -> list[Row]:
    """Return a row per receiver and solver."""
    rows: list[Row] = []
    missions = -(-dives // len(_DIVE_LENGTHS_S))
    console = Console(stderr=True)
    for number, (title, (receiver, frequencies, systems)) in enumerate(_RECEIVERS.items()):
        found: dict[str, list[Surfacing]] = {}
        for turn in track(range(missions), title, console=console, disable=not sys.stderr.isatty()):
            one = mission(receiver, frequencies, np.random.default_rng((seed, number, turn)))
            for name, part in solved(one, systems):
                found.setdefault(name, []).extend(part)
        rows += [{"receiver": title, "solver": name} | figures(parts) for name, parts in found.items()]
    return rows


def page(rows: Sequence[Row]) -> str:
    """Return the table as Markdown."""
    return table(COLUMNS, [_cells(row) for row in rows])


def _cells(row: Row) -> list[str]:
    first = " / ".join(">" if value is None else f"{value:.0f}" for value in row["first_right_s"])
    low, high = row["surfacings_with_false_pct_95"]
    return [
        row["receiver"], row["solver"], str(row["surfacings"]), first, str(row["never_fixed"]), f"{row['right_pct']:.1f}",
        str(row["false_fixes"]), f"{row['surfacings_with_false_pct']:.1f} ({low:.1f} to {high:.1f})",
    ]  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dives", type=int, default=0, help=f"per receiver (default {DIVES})")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--quick", action="store_true", help=f"{QUICK_DIVES} dives")
    parser.add_argument("--json", action="store_true", help="all figures, for programs")
    parser.add_argument("--data", help="not needed: everything is simulated")
    options = parser.parse_args()
    rows = measured(options.dives or (QUICK_DIVES if options.quick else DIVES), options.seed)
    print(json.dumps(rows, indent=1) if options.json else page(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
