#!/usr/bin/env python3
"""The campaign's runs beside RTKLIB: some runs of every family, solved by us, by rnx2rtkp and by demo5, judged by the same truth.

  peers.py [--runs N] [--seed S] [--only NAME,...] [--quick] [--json] [--jobs N]
  peers.py --choose > peers.toml              what suits each program in each family, on another seed

Runs 0 to N - 1 of each family of campaign.py, with the same seed: the same receivers, faults and places. We solve them as there. RTKLIB
gets what the receivers send (UBX, RTCM 3, with all faults) by way of convbin, the same ephemerides as wrong as ours are, and of the base
those epochs that reach the rover; where a session is told to restart, its programs are started anew. What rnx2rtkp cannot be given as the
rover has it is left out for all: base epochs that come late, and a base that tells another position on the way. Columns as in campaign.py.

We have the same options in every family but bands, mode and length. Each of RTKLIB's programs has those settings of eight (peers.toml) that
did best in the family on seed 2, counted as right less wrong fixes; `demo5 recommended` has what its author recommends.

After the table: every run in which one of the others has right fixes in 5 % of the epochs more than we, has the first of them 5 s sooner,
or has fewer wrong ones.
"""

import argparse
import importlib.util
import json
import sys
import tempfile
import tomllib
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from itertools import pairwise, product, repeat
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np
from rich.console import Console
from rich.progress import track

import kernel_cache  # noqa: F401  first of all
import rtklib
from arguments import add_data_unused, add_runs, parser_of
from campaign import Outcome, figures, outcome, simulated_run
from families import named
from results import table
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.options import Mode
from score_pos import Track
from simulated import Judged, Simulated, judge, solve
from simulated_files import Files, Span, by_demo5, by_rnx2rtkp, converted, epochs_of, sent, with_wrong_orbits

Row = dict[str, Any]
Outcomes = dict[str, list[Outcome]]  # by solver
Found = TypeVar("Found")

RUNS: Final = 10  # of each family
QUICK_RUNS: Final = 2
OURS: Final = "rtkmesh"
COLUMNS: Final = (
    "family", "solved by", "runs", "fix %", "right %", "wrong fixes", "wrong % of fixes", "runs with wrong", "longest wrong s",
    "first right fix s",
)  # fmt: skip
CHOSEN: Final = Path(__file__).with_suffix(".toml")
CHOOSING_SEED: Final = 2
CHOOSING_RUNS: Final = 4
_AHEAD_SHARE: Final = 0.05  # of the epochs, and
_AHEAD_S: Final = 5.0  # less is luck
_SYSTEMS: Final = "GREC"
# As in the options that demo5's recommended solutions of recordings were made with.
DEMO5: Final = """pos2-gloarmode=fix-and-hold
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


class Settings(NamedTuple):
    """What is set by family: whether a rover's motion is modelled, sigma of codes over that of phases, whether phases of which a u-blox
    receiver is not sure are there at all, and whether GLONASS integers are searched for as if receivers were of one make.
    """

    dynamics: bool
    code_ratio: int
    every_phase: bool
    glonass: bool = False

    def options(self) -> str:
        """Return them as options; phases are the business of the conversion."""
        dynamics = "on" if self.dynamics else "off"
        glonass = "pos2-gloarmode=on\n" if self.glonass else ""
        return f"pos1-dynamics={dynamics}\nstats-eratio1={self.code_ratio}\nstats-eratio2={self.code_ratio}\n{glonass}"


_ONE_MAKE: Final = "moving_base"  # the family of two receivers alike
_RECOMMENDED: Final = Settings(True, 300, False)


def all_settings(family: str) -> list[Settings]:
    """Return the settings to choose from in a family."""
    glonass = (False, True) if family == _ONE_MAKE else (False,)
    return [Settings(*values) for values in product((True, False), (100, 300), (False, True), glonass)]


@dataclass(frozen=True, slots=True)
class Peer:
    """Another program with its options."""

    name: str
    ambiguities: str
    further: str = ""
    demo5: bool = False
    chosen: bool = True  # its settings are chosen by family

    def settings(self, family: str) -> Settings:
        """Return its settings in a family."""
        return Settings(*_chosen()[self.name][family]) if self.chosen else _RECOMMENDED

    def solve(self, run: Simulated, files: Files, settings: Settings) -> list[Track | None]:
        """Return its solutions of a run, a track per start."""
        by: Callable[[GpsTime, Files, str, Span], Track | None] = by_demo5 if self.demo5 else by_rnx2rtkp
        return [by(run.start, files, self.options(run, settings), span) for span in spans(run)]

    def options(self, run: Simulated, settings: Settings) -> str:
        """Return its options for a run."""
        asked = run.setup.options
        systems = "".join(system for system in _SYSTEMS if system in run.setup.rover.systems)
        moving = asked.mode is Mode.MOVING_BASE
        mode = "movingbase" if moving else "kinematic"
        plain = rtklib.plain_options(mode, systems, asked.frequencies, self.ambiguities, demo5=self.demo5)
        base = self._of_moving_base(run) if moving else rtklib.base_options(run.base_ecef_m.tolist())
        return plain + self.further + settings.options() + base

    def _of_moving_base(self, run: Simulated) -> str:
        """Return what is known of the distance, and that the baseline is asked for; demo5 fixes less when it is told the distance."""
        if self.demo5:
            return "out-solformat=enu\n"
        asked = run.setup.options
        length = "" if asked.baseline_length_m is None else f"pos2-baselen={asked.baseline_length_m:.4f}\n"
        return f"{length}pos2-basesig={asked.baseline_sigma_m}\nout-solformat=enu\n"


@cache
def _chosen() -> dict[str, dict[str, list[Any]]]:
    return tomllib.loads(CHOSEN.read_text())


_PEERS: Final = (
    Peer("b34 continuous", "continuous"),
    Peer("b34 fix-and-hold", "fix-and-hold"),
    Peer("demo5 fix-and-hold", "fix-and-hold", DEMO5 + "pos2-arthres1=10\n", demo5=True),  # does not wait for a sure float
    Peer("demo5 recommended", "fix-and-hold", DEMO5, demo5=True, chosen=False),
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
        k = epochs_of(run.start, run.setup.rate_hz, found)
        inside = (k >= 0) & (k < run.setup.epochs)
        k, vector_m = k[inside], found.vector_m[inside]
        enu_m = vector_m if found.kind == "enu" else (vector_m - run.base_ecef_m) @ turn
        none.status[k], none.error_enu_m[k] = found.quality[inside], enu_m - run.baseline_ecef_m[k] @ turn
    return none


Tried = dict[tuple[str, Settings], Outcome]  # of one run, by program and settings


def tried(run: Simulated, family: str, number: int, settings_of: Callable[[Peer], Iterable[Settings]]) -> Tried:
    """Return what the other programs make of a run with each of some settings."""
    found: Tried = {}
    for every_phase in (False, True):
        wanted = [(peer, s) for peer in installed() for s in settings_of(peer) if s.every_phase is every_phase]
        if not wanted:
            continue
        with tempfile.TemporaryDirectory() as folder:
            files = with_wrong_orbits(run, converted(run, sent(run, every_phase=every_phase), Path(folder)))
            for peer, settings in wanted:
                found[peer.name, settings] = outcome(family, number, judged(run, peer.solve(run, files, settings)))
    return found


def measure(name: str, seed: int, number: int) -> dict[str, Outcome]:
    """Return what every solver makes of a run; nothing of one that cannot be given."""
    run = _run(name, seed, number)
    if not can_be_given(run):
        return {}
    ours = {OURS: outcome(name, number, judge(run, solve(run)))}
    theirs = {peer: one for (peer, _), one in tried(run, name, number, lambda peer: [peer.settings(name)]).items()}
    return ours | {peer.name: theirs[peer.name] for peer in installed()}


def _run(name: str, seed: int, number: int) -> Simulated:
    return simulated_run(named(name)[0], seed, number)


def measure_all(name: str, seed: int, number: int) -> Tried:
    """Return what those programs whose settings are chosen make of a run with all settings."""
    run = _run(name, seed, number)
    return tried(run, name, number, lambda peer: all_settings(name) if peer.chosen else ()) if can_be_given(run) else {}


def campaign(measured: Callable[[str, int, int], Found], names: Sequence[str], seed: int, runs: int, jobs: int) -> dict[str, list[Found]]:
    """Return what was measured of every run, by family, without the runs that cannot be given."""
    names_of, numbers = [name for name in names for _ in range(runs)], [*range(runs)] * len(names)
    gathered: dict[str, list[Found]] = {name: [] for name in names}
    with ProcessPoolExecutor(jobs) as pool:
        done = pool.map(measured, names_of, repeat(seed), numbers)
        shown = track(done, "runs", len(numbers), console=Console(stderr=True), disable=not sys.stderr.isatty())
        for name, found in zip(names_of, shown, strict=True):
            gathered[name] += [found] if found else []
    return {name: found for name, found in gathered.items() if found}


def by_solver(gathered: dict[str, list[dict[str, Outcome]]]) -> dict[str, Outcomes]:
    """Return the outcomes of each family by solver."""
    return {name: {solver: [found[solver] for found in runs] for solver in runs[0]} for name, runs in gathered.items()}


def chosen(gathered: dict[str, list[Tried]]) -> str:
    """Return the file of the settings that did best, by program and family."""
    lines = [f"# Settings of RTKLIB's programs by family: {', '.join(Settings._fields)}. Made by peers.py --choose."]
    for peer in (peer for peer in installed() if peer.chosen):
        lines.append(f"\n[{json.dumps(peer.name)}]")
        lines += [f"{name} = {json.dumps(best(peer.name, runs))}" for name, runs in gathered.items()]
    return "\n".join(lines)


def best(peer: str, runs: Sequence[Tried]) -> Settings:
    """Return the settings with the most right fixes less wrong ones; of equals the first."""
    tried_here = [settings for name, settings in runs[0] if name == peer]
    return max(tried_here, key=lambda settings: sum(_right(found[peer, settings]) - found[peer, settings].wrong for found in runs))


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
    names = [family.name for family in named(options.only)]
    if options.choose:
        print(chosen(campaign(measure_all, names, CHOOSING_SEED, options.runs or CHOOSING_RUNS, options.jobs)))
        return 0
    runs = options.runs or (QUICK_RUNS if options.quick else RUNS)
    gathered = by_solver(campaign(measure, names, options.seed, runs, options.jobs))
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
    parser = parser_of(__doc__)
    add_runs(parser, f"of each family (default {RUNS})", f"{QUICK_RUNS} runs of each family")
    parser.add_argument("--only", help="names of families, with commas between")
    parser.add_argument("--choose", action="store_true", help="try all settings and print those that did best")
    add_data_unused(parser)
    options = parser.parse_args()
    try:
        named(options.only)
    except ValueError as error:
        parser.error(str(error))
    return options


if __name__ == "__main__":
    sys.exit(main())
