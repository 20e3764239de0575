#!/usr/bin/env python3
"""What known geometry gives the search of integers: attitude from single epochs, without, with lengths and with the shape.

  attitude_search.py [--data DIR] [--quick] [--json] [--continuous]

Simulated: the boat of the scenarios with three and four antennas (2.0 m by 1.2 m) on waves, u-blox-like receivers, every epoch by itself
(--continuous: ambiguities carried on), several seeds; an attitude is right when every baseline is within 5 cm of the truth. Recorded:
two survey antennas 0.99 m apart (tokyo_static) and two M8P 0.33 m apart (galway_a, base epochs with gaps), right is within 5 cm of the
median of the fixes with all systems and bands; `RTKLIB` is rnx2rtkp's moving base, with `pos2-baselen` for its length, and its epochs are
those that it has a solution for. `none`: the solvers
as they are, all must fix; `lengths`: each is told the length of its baseline; `shape`: `attitude.search.choose` on their candidates;
`window`: the same and down within 15 degrees of the vertical. `best`: the first candidates are right, in % of the epochs; `accepted` in
% of the epochs, `wrong` of these, by number; `ms`: median and 99 % of the choice.
"""

import argparse
import json
import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from math import radians
from pathlib import Path
from time import process_time
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import kernel_cache  # noqa: F401  first of all
import rtklib
from cases import Case, data_folder, load
from results import table
from rtkmesh.attitude.rigid_body import Layout
from rtkmesh.attitude.rotation import NED_FROM_ENU
from rtkmesh.attitude.search import Candidates, Choice, Expectation, choose
from rtkmesh.gnss.frames import enu_from_ecef_at
from rtkmesh.gnss.time import GpsTime
from rtkmesh.models.ephemeris_table import EphemerisTable
from rtkmesh.rtk.candidates import CandidateTable
from rtkmesh.rtk.engine import Rtk
from rtkmesh.rtk.options import AmbiguityMode, AmbiguityOptions, Mode, RtkOptions
from rtkmesh.rtk.session import SessionOptions, pairing_for
from rtkmesh.rtk.solution import Status
from rtkmesh.simulation.faults import with_orbit_error
from rtkmesh.simulation.receiver import Observed
from rtkmesh.simulation.scenario import SCENARIOS, open_stream, truth
from rtkmesh.simulation.sky import KLOBUCHAR, SATELLITES, broadcast
from rtkmesh_services.cli.offline import Run, open_inputs
from score_pos import FIX

Row = dict[str, Any]
Vector = NDArray[np.float64]

NAMES: Final = ("rover", "heading", "starboard", "bow")
VARIANTS: Final = (("G", 1), ("GEJC", 1), ("GREJC", 2))
CASE: Final = "tokyo_static_l125"
LENGTH_M: Final = 0.990
RECORDED: Final = {CASE: LENGTH_M, "galway_a": 0.330}
ENDS: Final = ((0, 1), (0, 2), (0, 3), (1, 2))
TILT_RAD: Final = radians(15.0)
SHAPES: Final = (
    ("shape", (0,), np.pi), ("shape, window", (0,), TILT_RAD), ("shape", (0, 1), np.pi), ("shape, triangle", (0, 1, 3), np.pi),
    ("shape", (0, 1, 2), np.pi), ("shape, window", (0, 1, 2), TILT_RAD),
)  # fmt: skip
COLUMNS: Final = ("observations", "antennas", "geometry", "epochs", "best right %", "accepted %", "wrong", "ms 50 / 99 %")
_RIGHT_M: Final = 0.05
_SIGMA_M: Final = 0.005  # of a known length
_FIRST: Final = GpsTime(2445, 0.0)
_WEEK_S: Final = 604800


@dataclass(slots=True)
class Tally:
    """What became of the epochs of a variant."""

    epochs: int = 0
    right: int = 0
    accepted: int = 0
    wrong: int = 0
    ms: list[float] = field(default_factory=list[float])

    def add(self, *, right: bool, accepted: bool, ms: float = float("nan")) -> None:
        """Count an epoch; ``right``: of what was best, whether it was accepted or not."""
        self.epochs, self.right, self.accepted = self.epochs + 1, self.right + right, self.accepted + accepted
        self.wrong += accepted and not right
        self.ms.append(ms)


Tallies = defaultdict[tuple[str, int, str], Tally]


def boat_layout() -> Layout:
    """Return where the boat's antennas are."""
    return Layout(NAMES, np.array([SCENARIOS["boat"].antennas[name].offset_m for name in NAMES]))


def options(systems: str, frequencies: int, mode: AmbiguityMode, length_m: float | None) -> RtkOptions:
    """Return the options of a solver between two antennas."""
    return RtkOptions(
        mode=Mode.MOVING_BASE, systems=systems, frequencies=frequencies, baseline_length_m=length_m, baseline_sigma_m=_SIGMA_M,
        ambiguity=AmbiguityOptions(mode=mode),
    )  # fmt: skip


def observed(seed: int, epochs: int) -> tuple[GpsTime, list[list[Observed]]]:
    """Return the start of a run and the observations of all antennas of the boat, an epoch a list."""
    start = _FIRST + float(np.random.default_rng(seed).integers(_WEEK_S))
    receivers = [open_stream("boat", name, seed=seed, rate_hz=1.0, start=start).receiver() for name in NAMES]
    return start, [[receiver.observe(start + float(k)) for receiver in receivers] for k in range(epochs)]


def ephemerides(start: GpsTime, seed: int, seconds: int) -> EphemerisTable:
    """Return what the satellites broadcast, as wrong as that is."""
    table_ = EphemerisTable()
    for time in (start, start + float(seconds)):
        for satellite in SATELLITES.tolist():
            table_.add(with_orbit_error(broadcast(satellite, time), seed))
    return table_


def candidates(found: CandidateTable, start: int, end: int, ned_from_ecef: Vector) -> Candidates:
    """Return the candidates of a solver as the search takes them."""
    return Candidates(
        start, end, found.baselines_ecef_m @ ned_from_ecef.T, ned_from_ecef @ found.cov_ecef_m2 @ ned_from_ecef.T, found.norms, found.count,
        found.beyond, found.satellite, found.signal, found.base_signal, found.integers,
    )  # fmt: skip


def simulated(seed: int, epochs: int, systems: str, frequencies: int, mode: AmbiguityMode, tallies: Tallies) -> None:
    """Solve a run of the boat in all ways."""
    layout, tell = boat_layout(), truth("boat", seed=seed)
    start, run = observed(seed, epochs)
    issues, variant = ephemerides(start, seed, epochs), f"{systems}, {frequencies}"
    lengths = [float(np.linalg.norm(layout.positions_m[e] - layout.positions_m[s])) for s, e in ENDS]
    plain = [Rtk(options(systems, frequencies, mode, None)) for _ in ENDS]
    known = [Rtk(options(systems, frequencies, mode, length)) for length in lengths]
    for seen in run:
        at = tell(seen[0].true_time).antennas_ecef_m
        turn = NED_FROM_ENU @ enu_from_ecef_at(at["rover"])
        true = [turn @ (at[NAMES[e]] - at[NAMES[s]]) for s, e in ENDS]
        results = [[engine.step(seen[e].epoch, seen[s].epoch, issues, KLOBUCHAR) for engine, (s, e) in zip(engines, ENDS, strict=True)]
                   for engines in (plain, known)]  # fmt: skip
        tables = [engine.candidates() for engine in known]
        for name, solutions in zip(("none", "lengths"), results, strict=True):
            good = [bool(np.linalg.norm(turn @ s.baseline_ecef_m - t) < _RIGHT_M) for s, t in zip(solutions, true, strict=True)]
            fixed = [s.status is Status.FIX for s in solutions]
            for count in (1, 2, 3):
                tallies[variant, count + 1, name].add(right=all(good[:count]), accepted=all(fixed[:count]))
        for name, which, tilt_rad in SHAPES:
            found = [t for k in which if (t := tables[k]) is not None]
            given = [candidates(t, *ENDS[k], turn) for t, k in zip(found, which, strict=False)] if len(found) == len(which) else []
            count = len({antenna for k in which for antenna in ENDS[k]})
            _chosen(tallies[variant, count, name], layout, given, [true[k] for k in which], tilt_rad)


def _chosen(tally: Tally, layout: Layout, given: Sequence[Candidates], true: Sequence[Vector], tilt_rad: float) -> None:
    """Choose among the candidates and count what came of it."""
    begun = process_time()
    choice = choose(layout, given, Expectation(tilt_rad))
    ms = (process_time() - begun) * 1e3
    tally.add(right=_right(choice, given, true), accepted=choice.accepted, ms=ms)


def _right(choice: Choice, given: Sequence[Candidates], true: Sequence[Vector]) -> bool:
    chosen = zip(choice.chosen, given, true, strict=True) if choice.chosen else ()
    return bool(choice.chosen) and all(np.linalg.norm(c.baselines_ned_m[k] - t) < _RIGHT_M for k, c, t in chosen)


def run_of(case: Case, told: RtkOptions) -> Run:
    """Return a run over a recorded pair."""
    date = GpsTime.from_calendar(*(int(part) for part in case.date.split("-")), 12) if case.date else None
    inputs = open_inputs(case.rover, case.base, case.navigation, date)
    return Run(inputs, SessionOptions(told, pairing_for(told, replay=True), None, navigation_streams=len(case.navigation)))


def solved(case: Case, told: RtkOptions) -> Iterator[tuple[Vector, bool, Vector, CandidateTable | None]]:
    """Yield per epoch of a recording: baseline (ECEF), whether it is fixed, where its base is, and the candidates."""
    run = run_of(case, told)
    for solution in run.solutions():
        if np.isfinite(solution.baseline_ecef_m).all():
            yield solution.baseline_ecef_m, solution.status is Status.FIX, solution.base_ecef_m, run.session.engine.candidates()


def median_baseline(case: Case) -> Vector:
    """Return the median of the fixes with all that was recorded."""
    told = options("GREJC", 3, AmbiguityMode.CONTINUOUS, None)
    return np.asarray(np.median([b for b, fixed, *_ in solved(case, told) if fixed], axis=0), np.float64)


def recorded(case: Case, length_m: float, mode: AmbiguityMode, tallies: Tallies) -> None:
    """Solve a recorded pair with GPS on one frequency in all ways, and by RTKLIB."""
    true_ecef_m, variant = median_baseline(case), f"{case.name}: G, 1"
    layout = Layout(("base", "rover"), np.array([[0.0, 0.0, 0.0], [length_m, 0.0, 0.0]]))
    for name, told_m in (("none", None), ("lengths", length_m)):
        for baseline, fixed, base_ecef_m, found in solved(case, options("G", 1, mode, told_m)):
            tallies[variant, 2, name].add(right=bool(np.linalg.norm(baseline - true_ecef_m) < _RIGHT_M), accepted=fixed)
            if told_m is None:
                continue
            turn = NED_FROM_ENU @ enu_from_ecef_at(base_ecef_m) if np.isfinite(base_ecef_m).all() else np.eye(3)
            given = [candidates(found, 0, 1, turn)] if found is not None else []
            _chosen(tallies[variant, 2, "shape"], layout, given, [turn @ true_ecef_m], np.pi)
            _chosen(tallies[variant, 2, "shape, window"], layout, given, [turn @ true_ecef_m], TILT_RAD)
        if not rtklib.missing():
            by_rtklib(tallies[variant, 2, f"RTKLIB, {name}"], case, mode, told_m, true_ecef_m)


def by_rtklib(tally: Tally, case: Case, mode: AmbiguityMode, length_m: float | None, true_ecef_m: Vector) -> None:
    """Count RTKLIB's solutions of a recorded pair, as a moving base whose length it is told or not."""
    track = rtklib.moving_base(case, "G", 1, mode.value, length_m)
    true_enu_m = enu_from_ecef_at(np.array(case.base_ecef_m)) @ true_ecef_m
    for vector, quality in zip(track.vector_m, track.quality.tolist(), strict=True):
        tally.add(right=bool(np.linalg.norm(vector - true_enu_m) < _RIGHT_M), accepted=quality == FIX)


def page(tallies: Tallies) -> str:
    """Return the table as Markdown."""
    return table(COLUMNS, [_cells(key, tally) for key, tally in sorted(tallies.items())])


def _cells(key: tuple[str, int, str], tally: Tally) -> list[str]:
    share = 100.0 / max(tally.epochs, 1)
    timed = "" if np.isnan(tally.ms).all() else " / ".join(f"{value:.2f}" for value in np.nanpercentile(tally.ms, (50, 99)))
    return [
        key[0],
        str(key[1]),
        key[2],
        str(tally.epochs),
        f"{share * tally.right:.1f}",
        f"{share * tally.accepted:.1f}",
        str(tally.wrong),
        timed,
    ]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of the recordings")
    parser.add_argument("--quick", action="store_true", help="two seeds of a hundred epochs")
    parser.add_argument("--only", help="observations, like G,1")
    parser.add_argument("--seeds", type=int, default=8, help="runs of 300 epochs")
    parser.add_argument("--json", action="store_true", help="all figures, for programs")
    parser.add_argument("--continuous", action="store_true", help="ambiguities are carried on")
    chosen = parser.parse_args()
    mode = AmbiguityMode.CONTINUOUS if chosen.continuous else AmbiguityMode.INSTANTANEOUS
    tallies: Tallies = defaultdict(Tally)
    seeds, epochs = (2, 100) if chosen.quick else (chosen.seeds, 300)
    variants = [v for v in VARIANTS if chosen.only in (None, f"{v[0]},{v[1]}")]
    for systems, frequencies in variants[:1] if chosen.quick else variants:
        for seed in range(seeds):
            simulated(seed, epochs, systems, frequencies, mode, tallies)
    data = chosen.data or data_folder()
    if data is not None:
        for case in load(data, list(RECORDED)):
            recorded(case, RECORDED[case.name], mode, tallies)
    else:
        print("attitude_search: no recordings: the simulator alone", file=sys.stderr)
    rows = [{"variant": v, "antennas": n, "geometry": g, **{k: getattr(t, k) for k in ("epochs", "right", "accepted", "wrong")}}
            for (v, n, g), t in sorted(tallies.items())]  # fmt: skip
    print(json.dumps(rows, indent=1) if chosen.json else page(tallies))
    return 0


if __name__ == "__main__":
    sys.exit(main())
