#!/usr/bin/env python3
"""Are published covariances honest? Normalised errors squared e' P^-1 e / 3 of fixes, floats, velocities: 1 is honest, more is too sure.

  sigmas.py [--data DIR] [--runs N] [--seed S] [--quick] [--only positions|velocities] [--json]

Simulated: runs of the campaign's open-sky families; every position against the truth. Recorded: static pairs against their known position
or, where there is none, against their own mean fix; the mean error of the fixes is taken away first where the recordings' page says that
antenna phase centres differ (*) or that the truth is such a mean (†). Floats are those of a solver without integers (AmbiguityMode.OFF).
A float's error stays: a whole recording without integers is one sample of three numbers, whose mean is 0.1 to 2.6 (90 %) if all is honest.
So on recordings floats begin anew every 150 s (or 20 epochs), as long as simulated runs are. Velocities are those of all epochs with a
relative solution, whatever its status; recordings stand still, but are solved as if they moved; simulated rovers are also solved at 5 Hz,
and at 1 Hz without their Dopplers. Recorded rovers that move are solved without Dopplers and held against these, where they are faster
than a half metre per second; covariance and error are then those of both. E, N, U: root mean square of error over sigma per axis. Errors
of neighbouring epochs hang together: behind the mean of all is its standard error, as the means of runs and pieces scatter.

Where a mean is the truth or is taken away, what lasts as long as the recording is not seen, and the mean to expect is not 1 but the share
of the phases' squared errors (with whole cycles, without GLONASS) that is left when each signal's own mean is taken away.
"""

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import kernel_cache  # noqa: F401  first of all
import pair_errors
import recorded
import slips
from campaign import Rates, simulated_run
from cases import Case, data_folder, load
from error_series import Series
from families import FAMILIES, Family
from results import table
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.frames import enu_from_ecef_at
from rtkmesh.rtk.options import AmbiguityMode, AmbiguityOptions, Mode, RtkOptions
from rtkmesh.rtk.solution import Solution, Status
from simulated import WRONG_M, Simulated, solve

Row = dict[str, Any]
Vector = NDArray[np.float64]

RUNS: Final = 20
QUICK_RUNS: Final = 4
SIMULATED: Final = ("open", "open_survey_l1", "open_f9p_l1", "open_m8_l1")
MOVING: Final = (*SIMULATED, "urban", "forest", "tunnel", "moving_base")  # families of which velocities are judged too
PACES: Final = (("velocity", 1, True), ("velocity at 5 Hz", 5, True), ("velocity without Dopplers", 1, False))
POSITIONS, VELOCITIES = "positions", "velocities"
RELATIVE: Final = (Status.FIX, Status.FLOAT, Status.DGPS)
# Static recordings, and why their mean error is taken away ("" : it is not).
RECORDED: Final = {
    "tokyo_static_l125": "†",
    "tokyo_static_l1gps": "†",
    "kanagawa_60s": "",
    "geonet_2005": "†",
    "stromlo_l12": "*",
    "stromlo_l125": "*",
    "galway_a_glw1": "†",
    "nl_35km": "*",
}
MOVERS: Final = ("galway_b_walk", "umea_r001", "yamatogawa_walk")  # walkers and a machine in a forest, with Dopplers
MOVING_MPS: Final = 0.5  # slower ones stand in part
QUICK: Final = ("tokyo_static_l1gps", "kanagawa_60s")
COLUMNS: Final = (
    "data",
    "solutions",
    "number",
    "mean",
    "expected",
    "mean of the lower 95 %",
    "E",
    "N",
    "U",
    "sigma 3D (m, m/s), median",
    "error 3D (m, m/s), median",
    "root mean square",
)
PIECE_S: Final = 150.0  # of a recording, after which floats begin anew
PIECE_EPOCHS: Final = 20  # at least


@dataclass(frozen=True, slots=True, eq=False)
class Errors:
    """Errors (n, 3) and covariances (n, 3, 3) of solutions, east-north-up, metres or metres per second; ``parts`` are the numbers of those
    of each run or piece, where there are several.
    """

    error: Vector
    cov: Vector
    parts: tuple[int, ...] = ()

    def squares(self) -> Vector:
        """Return the normalised errors squared, divided by the number of axes."""
        return np.array([e @ np.linalg.solve(p, e) / 3.0 for e, p in zip(self.error, self.cov, strict=True)])

    def standard_error(self) -> float:
        """Return that of the mean of the squares, as the means of the parts scatter; NaN of fewer than two."""
        squares, ends = self.squares(), np.cumsum(self.parts).tolist()
        means = [float(squares[end - count : end].mean()) for count, end in zip(self.parts, ends, strict=True) if count]
        return float(np.std(means, ddof=1) / np.sqrt(len(means))) if len(means) > 1 else np.nan


def errors(solutions: Sequence[Solution], truth_ecef_m: Vector) -> Errors:
    """Return errors of positions against one truth or one per solution."""
    return _in_horizon([(s.position_ecef_m, s.position_cov_ecef_m2) for s in solutions], truth_ecef_m, solutions)


def velocity_errors(solutions: Sequence[Solution], truth_ecef_mps: Vector) -> Errors:
    """Return errors of velocities against one truth or one per solution."""
    return _in_horizon([(s.velocity_ecef_mps, s.velocity_cov_ecef_m2ps2) for s in solutions], truth_ecef_mps, solutions)


def _in_horizon(found: Sequence[tuple[Vector, Vector]], truth: Vector, solutions: Sequence[Solution]) -> Errors:
    """Return errors of vectors with their covariances (ECEF), in the horizon of the first solution."""
    if not found:
        return Errors(np.empty((0, 3)), np.empty((0, 3, 3)))
    turn, (value, cov) = enu_from_ecef_at(solutions[0].position_ecef_m), map(np.array, zip(*found, strict=True))
    return Errors((value - truth) @ turn.T, turn @ cov @ turn.T)


def figures(found: Errors) -> Row:
    """Return what the errors say of the covariances."""
    squares = np.sort(found.squares())
    if not len(squares):
        return {"number": 0}
    sigma_m = np.sqrt(np.diagonal(found.cov, axis1=1, axis2=2))
    per_axis = np.sqrt(np.mean((found.error / sigma_m) ** 2, axis=0))
    return {
        "number": len(squares),
        "mean": float(squares.mean()),
        "standard_error": found.standard_error(),
        "trimmed": float(squares[: max(1, round(0.95 * len(squares)))].mean()),
        "axes": [float(v) for v in per_axis],
        "sigma_m": float(np.median(np.linalg.norm(sigma_m, axis=1))),
        "error_m": float(np.median(np.linalg.norm(found.error, axis=1))),
        "rms_m": float(np.sqrt(np.mean(np.sum(found.error**2, axis=1)))),
    }


def of_simulation(family: Family, seed: int, runs: int, mode: AmbiguityMode) -> Errors:
    """Return the errors of a family's fixes, or of its floats with integers left off."""
    return joined([of_run(simulated_run(family, seed, run), mode) for run in range(runs)])


def of_run(simulated: Simulated, mode: AmbiguityMode) -> Errors:
    """Return the errors of a run's fixes, or of its floats with integers left off."""
    setup = replace(simulated.setup, options=replace(simulated.setup.options, ambiguity=AmbiguityOptions(mode=mode)))
    solutions = solve(replace(simulated, setup=setup))
    wanted = Status.FLOAT if mode is AmbiguityMode.OFF else Status.FIX
    chosen = [k for k, s in enumerate(solutions) if s is not None and s.status is wanted]
    found = [s for s in solutions if s is not None and s.status is wanted]
    return errors(found, np.array([simulated.rover[k].position_ecef_m for k in chosen]).reshape(-1, 3))


def of_velocities(family: Family, seed: int, runs: int, rate_hz: int = 1, dopplers: bool = True) -> Errors:
    """Return the errors of a family's velocities at a rate, of rovers with Dopplers or without."""
    rates = Rates(rate_hz)
    return joined([_velocities_of(simulated_run(family, seed, run, rates), dopplers) for run in range(runs)])


def _velocities_of(simulated: Simulated, dopplers: bool) -> Errors:
    run = simulated if dopplers else replace(simulated, rover_epochs=[_without_dopplers(e) for e in simulated.rover_epochs])
    known = [(s, seen) for s, seen in zip(solve(run), simulated.rover, strict=True) if s is not None and _tells_velocity(s)]
    return velocity_errors([s for s, _ in known], np.array([seen.velocity_ecef_mps for _, seen in known]).reshape(-1, 3))


def _without_dopplers(epoch: Epoch) -> Epoch:
    return replace(epoch, doppler_hz=np.full(len(epoch.satellite), np.nan))


def _tells_velocity(solution: Solution) -> bool:
    return solution.status in RELATIVE and bool(np.isfinite(solution.velocity_ecef_mps).all())


def of_recorded_velocities(case: Case) -> Errors:
    """Return the errors of the velocities of a static pair."""
    found = recorded.solutions(case, RtkOptions(systems=case.systems, frequencies=case.frequencies))
    return velocity_errors([s for s in found if _tells_velocity(s)], np.zeros(3))


def of_mover(case: Case) -> Errors:
    """Return the errors of a recorded rover's velocities without Dopplers against those by its Dopplers alone, with both covariances."""
    scene = slips.recorded(case.name, case)
    by_doppler = slips.solve(replace(scene, options=replace(scene.options, mode=Mode.SINGLE)), scene.rover)
    found = slips.solve(scene, [_without_dopplers(epoch) for epoch in scene.rover])
    pairs = [(s, by_doppler[time]) for time, s in found.items() if time in by_doppler and _tells_velocity(s)]
    moving = [(s, other) for s, other in pairs if np.linalg.norm(other.velocity_ecef_mps) > MOVING_MPS]
    apart = [
        (s.velocity_ecef_mps - other.velocity_ecef_mps, s.velocity_cov_ecef_m2ps2 + other.velocity_cov_ecef_m2ps2) for s, other in moving
    ]
    return _in_horizon(apart, np.zeros(3), [s for s, _ in moving])


def of_recording(case: Case, offset: str, mode: AmbiguityMode) -> tuple[Errors, int]:
    """Return the errors of right fixes or of floats of a static pair, and how many fixes were left out as wrong."""
    options = RtkOptions(systems=case.systems, frequencies=case.frequencies)
    fixes = [s for s in recorded.solutions(case, options) if s.status is Status.FIX]
    position = np.array([s.position_ecef_m for s in fixes])
    middle = np.median(position, axis=0)
    right = np.linalg.norm(position - middle, axis=1) <= WRONG_M
    truth = position[right].mean(axis=0) if offset else np.array(case.truth.position_ecef_m)
    if mode is not AmbiguityMode.OFF:
        return errors([s for s, ok in zip(fixes, right, strict=True) if ok], truth), int(np.sum(~right))
    return joined([errors(piece, truth) for piece in _pieces(case)]), 0


def _pieces(case: Case) -> Iterator[list[Solution]]:
    """Yield the floats of a recording in pieces, each from a solver that begins with it; a rest of less than half a piece is left out."""
    scene = slips.recorded(case.name, case)
    scene = replace(scene, options=replace(scene.options, ambiguity=AmbiguityOptions(mode=AmbiguityMode.OFF)))
    length = max(round(PIECE_S / slips.usual_interval_s(scene)), PIECE_EPOCHS)
    for first in range(0, max(len(scene.rover) - length // 2, 1), length):
        yield [s for s in slips.solve(scene, scene.rover[first : first + length]).values() if s.status is Status.FLOAT]


def joined(parts: Sequence[Errors]) -> Errors:
    """Return the errors of all parts."""
    return Errors(np.concatenate([p.error for p in parts]), np.concatenate([p.cov for p in parts]), tuple(len(p.error) for p in parts))


def expected(case: Case) -> float:
    """Return the normalised squared error to expect of honest fixes whose own mean is the truth."""
    return share_of_change(pair_errors.of_pair(pair_errors.recorded_pair(case))["phase"])


def share_of_change(phases: Sequence[Series]) -> float:
    """Return which part of squared errors is left without the mean of each signal.

    They are errors about a baseline that fits all epochs best: it has taken its part of what lasts, three of the signals' degrees of
    freedom (and one for the clock).
    """
    total = sum(float(np.sum(s.error_m**2)) for s in phases)
    changing = sum(float(np.sum(s.without_mean().error_m ** 2)) for s in phases)
    signals = sum(len(s.error_m) for s in phases) / len({t for s in phases for t in s.time_s.tolist()})
    return changing / (changing + (total - changing) * (signals - 1.0) / (signals - 4.0))


def measured(data: Path | None, runs: int, seed: int, names: Sequence[str], kinds: Sequence[str]) -> Iterator[Row]:
    """Yield a row per kind of data and of solution, of positions, velocities or both."""
    for family in FAMILIES:
        if family.name in SIMULATED and POSITIONS in kinds:
            for title, mode in (("fix", AmbiguityMode.CONTINUOUS), ("float", AmbiguityMode.OFF)):
                yield {"data": f"simulated: {family.title}", "kind": title} | figures(of_simulation(family, seed, runs, mode))
        for title, rate_hz, dopplers in PACES if family.name in MOVING and VELOCITIES in kinds else ():
            found = figures(of_velocities(family, seed, runs, rate_hz, dopplers))
            yield {"data": f"simulated: {family.title}", "kind": title} | found
    for case in load(data, list(names)) if data else []:
        for title, mode in (("fix", AmbiguityMode.CONTINUOUS), ("float", AmbiguityMode.OFF)) if POSITIONS in kinds else ():
            found, wrong = of_recording(case, RECORDED[case.name], mode)
            mine = title == "fix" and RECORDED[case.name]
            row = figures(found) | ({"expected": expected(case)} if mine else {})
            yield {"data": f"{case.name}{RECORDED[case.name]}", "kind": title, "left_out": wrong} | row
        if VELOCITIES in kinds:
            yield {"data": case.name, "kind": "velocity"} | figures(of_recorded_velocities(case))
    for case in load(data, list(MOVERS)) if data and VELOCITIES in kinds else []:
        yield {"data": case.name, "kind": "velocity without Dopplers, against these"} | figures(of_mover(case))


def page(rows: Sequence[Row]) -> str:
    """Return the table as Markdown."""
    return table(COLUMNS, [_cells(row) for row in rows])


def _cells(row: Row) -> list[str]:
    if not row["number"]:
        return [row["data"], row["kind"], "0", *[""] * (len(COLUMNS) - 3)]
    kind = row["kind"] + (f", without {row['left_out']} wrong" if row.get("left_out") else "")
    spread = "" if np.isnan(row["standard_error"]) else f" ± {row['standard_error']:.2f}"
    mean = [f"{row['mean']:.2f}{spread}", f"{row.get('expected', 1.0):.2f}"]
    numbers = [f"{v:.2f}" for v in (row["trimmed"], *row["axes"])]
    return [row["data"], kind, str(row["number"]), *mean, *numbers, f"{row['sigma_m']:.4f}", f"{row['error_m']:.4f}", f"{row['rms_m']:.4f}"]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of the recordings")
    parser.add_argument("--runs", type=int, default=0, help=f"simulated runs per family (default {RUNS})")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--quick", action="store_true", help=f"{QUICK_RUNS} runs, two recordings")
    parser.add_argument("--only", choices=(POSITIONS, VELOCITIES), help="of these alone")
    parser.add_argument("--json", action="store_true", help="all figures, for programs")
    options = parser.parse_args()
    data = options.data or data_folder()
    if data is None:
        print("sigmas: no recordings (RTKMESH_DATA): simulation only", file=sys.stderr)
    runs = options.runs or (QUICK_RUNS if options.quick else RUNS)
    kinds = (options.only,) if options.only else (POSITIONS, VELOCITIES)
    rows = list(measured(data, runs, options.seed, QUICK if options.quick else tuple(RECORDED), kinds))
    print(json.dumps(rows, indent=1) if options.json else page(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
