#!/usr/bin/env python3
"""The campaign's runs beside RTKLIB: some runs of every family, solved by us, by rnx2rtkp and by demo5, judged by the same truth.

  peers.py [--runs N] [--seed S] [--only NAME,...] [--quick] [--json] [--jobs N]

Runs 0 to N - 1 of each family of campaign.py, with the same seed: the same receivers, faults and places. We solve them as there. RTKLIB
gets what the receivers send (UBX, RTCM 3, with all faults) by way of convbin, the same ephemerides as wrong as ours are, and of the base
those epochs that reach the rover; where a session is told to restart, its programs are started anew. What rnx2rtkp cannot be given as the
rover has it is left out for all: base epochs that come late, and a base that tells another position on the way. Columns as in campaign.py.

After the table: every run in which one of the others has right fixes in 5 % of the epochs more than we, has the first of them 5 s sooner,
or has fewer wrong ones.
"""

import argparse
import importlib.util
import json
import os
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
from rich.console import Console
from rich.progress import track

import kernel_cache  # noqa: F401  first of all
import rtklib
from campaign import Outcome, figures, outcome, simulated_run
from families import FAMILIES
from results import table
from rtkmesh.rtk.options import Mode
from score_pos import Track
from simulated import Judged, Simulated, judge, solve
from simulated_files import Files, Span, by_demo5, by_rnx2rtkp, converted, epochs_of, sent, with_wrong_orbits

Row = dict[str, Any]
Outcomes = dict[str, list[Outcome]]  # by solver

RUNS: Final = 10  # of each family
QUICK_RUNS: Final = 2
OURS: Final = "rtkmesh"
COLUMNS: Final = (
    "family", "solved by", "runs", "fix %", "right %", "wrong fixes", "wrong % of fixes", "runs with wrong", "longest wrong s",
    "first right fix s",
)  # fmt: skip
_AHEAD_SHARE: Final = 0.05  # of the epochs, and
_AHEAD_S: Final = 5.0  # less is luck
_SYSTEMS: Final = "GREC"
# As in the options that demo5's recommended solutions of recordings were made with.
_DEMO5: Final = """pos1-dynamics=on
pos2-gloarmode=fix-and-hold
pos2-arfilter=on
pos2-minfixsats=4
pos2-minholdsats=5
pos2-mindropsats=10
pos2-varholdamb=0.1
pos2-gainholdamb=0.01
pos2-arthresmin=3
pos2-arthresmax=3
pos2-rejionno=2
stats-prnaccelh=3
stats-prnaccelv=1
"""


@dataclass(frozen=True, slots=True)
class Peer:
    """Another program with its options; ``moving``: further ones for a moving base."""

    name: str
    ambiguities: str
    further: str = ""
    moving: str = ""
    demo5: bool = False

    def solve(self, run: Simulated, files: Files) -> list[Track | None]:
        """Return its solutions of a run, a track per start."""
        by: Callable[[Simulated, Files, str, Span], Track | None] = by_demo5 if self.demo5 else by_rnx2rtkp
        return [by(run, files, self.options(run), span) for span in spans(run)]

    def options(self, run: Simulated) -> str:
        """Return its options for a run."""
        asked = run.setup.options
        moving = asked.mode is Mode.MOVING_BASE
        systems = "".join(system for system in _SYSTEMS if system in run.setup.rover.systems)
        mode = "movingbase" if moving else "kinematic"
        plain = rtklib.plain_options(mode, systems, asked.frequencies, self.ambiguities, demo5=self.demo5)
        return plain + self.further + (self.moving + self._length(run) + "out-solformat=enu\n" if moving else _of_base(run))

    def _length(self, run: Simulated) -> str:
        """Return what is known of the length; demo5 fixes less when it is told."""
        asked = run.setup.options
        if asked.baseline_length_m is None or self.demo5:
            return ""
        return f"pos2-baselen={asked.baseline_length_m:.4f}\npos2-basesig={asked.baseline_sigma_m}\n"


def _of_base(run: Simulated) -> str:
    x, y, z = run.base_ecef_m.tolist()
    return f"out-solformat=xyz\nant2-postype=xyz\nant2-pos1={x:.4f}\nant2-pos2={y:.4f}\nant2-pos3={z:.4f}\n"


_MOVING_B34: Final = "pos1-dynamics=off\npos2-gloarmode=on\n"  # both antennas move alike and are of one make
_PEERS: Final = (
    Peer("b34 continuous", "continuous", "pos1-dynamics=on\n", _MOVING_B34),
    Peer("b34 fix-and-hold", "fix-and-hold", "pos1-dynamics=on\n", _MOVING_B34),
    Peer("demo5 recommended", "fix-and-hold", _DEMO5, demo5=True),
    Peer("demo5 at once", "fix-and-hold", _DEMO5 + "pos2-arthres1=10\n", demo5=True),
)


def installed() -> tuple[Peer, ...]:
    """Return the programs that are there."""
    if rtklib.missing():
        return ()
    demo5 = importlib.util.find_spec("pyrtklib5") is not None
    return tuple(peer for peer in _PEERS if demo5 or not peer.demo5)


def can_be_given(run: Simulated) -> bool:
    """Say whether RTKLIB's programs for files can be told what the rover has at each epoch: a base in one place, no epoch late."""
    setup = run.setup
    return setup.shift_at is None and all(told == second for second in range(setup.seconds) for told in setup.arrivals(second))


def spans(run: Simulated) -> list[Span]:
    """Return the parts of a run between the restarts that are told."""
    setup = run.setup
    starts = [round(o.start_s + o.duration_s) for o in setup.outages] if setup.told_restarts else []
    return list(pairwise([0.0, *map(float, starts), float(setup.seconds)]))


def judged(run: Simulated, tracks: Iterable[Track | None]) -> Judged:
    """Hold the solutions of another program against the truth of a run."""
    none = judge(run, [None] * run.setup.epochs)
    turn = run.site.ecef_from_enu()
    for found in tracks:
        if found is None:
            continue
        k = epochs_of(run, found)
        inside = (k >= 0) & (k < run.setup.epochs)
        k, vector_m = k[inside], found.vector_m[inside]
        enu_m = vector_m if found.kind == "enu" else (vector_m - run.base_ecef_m) @ turn
        none.status[k], none.error_enu_m[k] = found.quality[inside], enu_m - run.baseline_ecef_m[k] @ turn
    return none


def measure(name: str, seed: int, number: int) -> dict[str, Outcome]:
    """Return what every solver makes of a run; nothing of one that cannot be given."""
    family = next(f for f in FAMILIES if f.name == name)
    run = simulated_run(family, seed, number)
    if not can_be_given(run):
        return {}
    found = {OURS: outcome(name, number, judge(run, solve(run)))}
    with tempfile.TemporaryDirectory() as folder:
        peers = installed()
        files = with_wrong_orbits(run, converted(run, sent(run), Path(folder))) if peers else None
        return found | {peer.name: outcome(name, number, judged(run, peer.solve(run, files))) for peer in peers if files}


def _measure(item: tuple[str, int, int]) -> dict[str, Outcome]:
    return measure(*item)


def campaign(names: Sequence[str], seed: int, runs: int, jobs: int) -> dict[str, Outcomes]:
    """Return the outcomes of every family that can be given, by solver."""
    work = [(name, seed, number) for name in names for number in range(runs)]
    gathered: dict[str, Outcomes] = {}
    with ProcessPoolExecutor(jobs) as pool:
        done = track(pool.map(_measure, work), "runs", len(work), console=Console(stderr=True), disable=not sys.stderr.isatty())
        for (name, _, _), found in zip(work, done, strict=True):
            for solver, one in found.items():
                gathered.setdefault(name, {}).setdefault(solver, []).append(one)
    return gathered


def rows(gathered: dict[str, Outcomes]) -> list[Row]:
    """Return the figures by family and solver, and in total."""
    total: Outcomes = {}
    for outcomes in gathered.values():
        for solver, found in outcomes.items():
            total.setdefault(solver, []).extend(found)
    parts = [*gathered.items(), *([("total", total)] if len(gathered) > 1 else [])]
    return [{"family": name, "solver": solver} | figures(found) for name, outcomes in parts for solver, found in outcomes.items()]


def page(found: Sequence[Row]) -> str:
    """Return the table as Markdown."""
    return table(COLUMNS, [_cells(row) for row in found])


def _cells(row: Row) -> list[str]:
    first = " / ".join(">" if value is None else f"{value:.3g}" for value in row["first_right_s"])
    return [
        row["family"], row["solver"], str(row["runs"]), f"{row['fix_pct']:.1f}", f"{row['right_pct']:.1f}", str(row["wrong_fixes"]),
        f"{row['wrong_pct_of_fixes']:.2f}", str(row["runs_with_wrong"]), f"{row['longest_wrong_s']:g}", first,
    ]  # fmt: skip


def is_ahead(theirs: Outcome, ours: Outcome) -> bool:
    """Say whether another solver did better than we in a run, in one respect at least."""
    more = _right(theirs) - _right(ours) >= _AHEAD_SHARE * ours.possible
    sooner = np.isfinite(theirs.first_right_s) and theirs.first_right_s <= ours.first_right_s - _AHEAD_S
    return bool(more or sooner or theirs.wrong < ours.wrong)


def _right(one: Outcome) -> int:
    return one.fixes - one.wrong


def ahead(gathered: dict[str, Outcomes]) -> Iterator[str]:
    """Yield a line for every run in which another is ahead of us: right and wrong fixes and the first right one, ours and theirs."""
    for name, outcomes in gathered.items():
        for place, ours in enumerate(outcomes[OURS]):
            better = [f"{solver} {_short(found[place])}" for solver, found in outcomes.items() if is_ahead(found[place], ours)]
            if better:
                yield f"{name} {ours.run} ({ours.possible} epochs): ours {_short(ours)}; {'; '.join(better)}"


def _short(one: Outcome) -> str:
    first = f"first at {one.first_right_s:g} s" if np.isfinite(one.first_right_s) else "none right"
    return f"{_right(one)} right {one.wrong} wrong, {first}"


def main() -> int:
    options = _options()
    names = [f.name for f in FAMILIES if not options.only or f.name in options.only.split(",")]
    gathered = campaign(names, options.seed, options.runs or (QUICK_RUNS if options.quick else RUNS), options.jobs)
    found, lines = rows(gathered), list(ahead(gathered))
    if options.json:
        print(json.dumps({"seed": options.seed, "rows": found, "ahead": lines}, indent=1))
        return 0
    print(page(found))
    if lines:
        print(f"Runs in which another is ahead (campaign.py --only FAMILY --run N --seed {options.seed} --trace shows ours):\n")
        print("```text\n" + "\n".join(lines) + "\n```")
    return 0


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=0, help=f"of each family (default {RUNS})")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", help="names of families, with commas between")
    parser.add_argument("--quick", action="store_true", help=f"{QUICK_RUNS} runs of each family")
    parser.add_argument("--json", action="store_true", help="all figures, for programs")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--data", help="not needed: everything is simulated")
    options = parser.parse_args()
    unknown = set((options.only or "open").split(",")) - {family.name for family in FAMILIES}
    if unknown:
        parser.error(f"no family {', '.join(sorted(unknown))}; there are {', '.join(family.name for family in FAMILIES)}")
    return options


if __name__ == "__main__":
    sys.exit(main())
