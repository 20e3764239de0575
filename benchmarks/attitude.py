#!/usr/bin/env python3
"""Attitude of two, three and four antennas on a simulated boat, against the truth: moving bases, one rigid body, one verdict.

  attitude.py [--quick] [--json]

A boat of 2 by 1.2 m on waves at 2 Hz, at random places and times; receivers of F9P class with multipath and slips. Errors are root
mean squares of the attitudes that passed their test; honesty is the mean of squared errors over what their covariance says (1: exact,
above: too sure); wrong: passed, and off by more than 5 sigmas and 1 degree in any angle. Available: share of epochs after the first fix
of all baselines. Levels: protection levels of heading, pitch, roll (median), and how many attitudes that passed were further off.
`publish ms`: from the last baseline's solution to the attitude, judged, with levels (median, 99 %), on this machine.

Second table: a fault of one antenna in every epoch, in a random direction: how often it is found, and what of the attitudes that pass all
the same is beyond its sigmas (3.4 of them) and beyond its levels.
"""

import argparse
import json
import sys
import time
from dataclasses import dataclass, field, replace
from math import radians
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import kernel_cache  # noqa: F401  first of all
from results import table
from rtkmesh.attitude.integrity import Finding, judged
from rtkmesh.attitude.joint import Edge, angles_covariance, joint
from rtkmesh.attitude.protection import Guarding, levels
from rtkmesh.attitude.rigid_body import Fit, Layout
from rtkmesh.attitude.rotation import NED_FROM_ENU, rotation_of_angles, vector_of, wrapped
from rtkmesh.gnss.frames import enu_from_ecef_at
from rtkmesh.gnss.integrity import Integrity
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.options import Mode, RtkOptions
from rtkmesh.rtk.session import Session, SessionOptions, Source, pairing_for
from rtkmesh.rtk.solution import Solution, Status
from rtkmesh.simulation.classes import F9P, moving
from rtkmesh.simulation.receiver import Observed, Receiver
from rtkmesh.simulation.sky import KLOBUCHAR, SATELLITES, absolute_s, broadcast
from rtkmesh.simulation.trajectories import AntennaPath, Pose, Site, boat

Vector = NDArray[np.float64]
Row = dict[str, Any]

PLACES: Final = {"a": (-1.0, -0.6, -2.0), "b": (1.0, -0.6, -2.0), "c": (-1.0, 0.6, -2.0), "d": (1.0, 0.6, -2.0)}
COLUMNS: Final = (
    "antennas", "epochs", "available %", "heading deg", "pitch deg", "roll deg", "honesty", "excluded", "failed", "wrong",
    "levels deg", "beyond", "publish ms",
)  # fmt: skip
FAULTS: Final = (
    "antennas", "fault", "mm", "epochs", "found %", "passed %", "beyond its sigmas %", "beyond its levels %", "largest error by level",
)  # fmt: skip
STEP_S: Final = 0.5
UNSEEN_RAD: Final = radians(10.0)
GUARDING: Final = Guarding(unseen_sigma_rad=UNSEEN_RAD)
SIZES_M: Final = (0.005, 0.01, 0.02, 0.05)
_WRONG_SIGMAS, _WRONG_RAD = 5.0, radians(1.0)
_WITHIN: Final = 3.4  # sigmas of an angle: one in 1500 is further off
_FIRST: Final = GpsTime(2445, 0.0)
_ON_A_BOAT: Final = replace(F9P, signals=moving(F9P.signals, 15.0))  # as in ``families``


@dataclass(slots=True)
class Score:
    """What the attitudes of some antennas were worth."""

    epochs: int = 0
    passed: int = 0
    excluded: int = 0
    failed: int = 0
    wrong: int = 0
    errors_rad: list[list[float]] = field(default_factory=list[list[float]])
    normalised: list[float] = field(default_factory=list[float])
    levels_rad: list[list[float]] = field(default_factory=list[list[float]])
    beyond: int = 0
    took_ms: list[float] = field(default_factory=list[float])

    def take(self, layout: Layout, edges: list[Edge], pose: Pose) -> None:
        """Judge one epoch's baselines; none at all is an epoch without an attitude."""
        self.epochs += 1
        if not edges:
            return
        begun = time.perf_counter()
        measured = joint(layout, edges)
        verdict = judged(layout, measured)
        bounds = levels(layout, measured, verdict, GUARDING)
        self.took_ms.append((time.perf_counter() - begun) * 1e3)
        self.failed += verdict.integrity is Integrity.FAILED
        self.excluded += bool(verdict.excluded)
        if verdict.fit is not None and verdict.integrity is Integrity.OK:
            self._passed(verdict.fit, pose, bounds.rad)

    def row(self, antennas: int) -> Row:
        """Return the figures."""
        errors = np.array(self.errors_rad).reshape(-1, 3)
        rms = np.array([np.degrees(np.sqrt(np.mean(e**2))) if np.isfinite(e).any() else np.nan for e in errors.T])
        return {
            "antennas": antennas,
            "epochs": self.epochs,
            "available_pct": 100.0 * self.passed / max(self.epochs, 1),
            "rms_deg": rms.tolist(),
            "honesty": float(np.mean(self.normalised)) if self.normalised else float("nan"),
            "excluded": self.excluded,
            "failed": self.failed,
            "wrong": self.wrong,
            "levels_deg": np.degrees(np.median(self.levels_rad, axis=0)).tolist() if self.levels_rad else [],
            "beyond": self.beyond,
            "publish_ms": np.percentile(self.took_ms, (50, 99)).tolist() if self.took_ms else [],
        }

    def _passed(self, fit: Fit, pose: Pose, levels_rad: Vector) -> None:
        self.passed += 1
        errors, sigmas = _errors_and_sigmas(fit, pose)
        seen = np.isfinite(sigmas)
        self.errors_rad.append(np.where(seen, errors, np.nan).tolist())
        self.levels_rad.append(levels_rad.tolist())
        self.beyond += bool(np.any(np.abs(errors) > levels_rad))
        self.normalised.append(_normalised(fit, rotation_of_angles(pose.heading_rad, pose.pitch_rad, pose.roll_rad)))
        self.wrong += bool(np.any(np.abs(errors[seen]) > np.maximum(_WRONG_SIGMAS * sigmas[seen], _WRONG_RAD)))


@dataclass(slots=True)
class FaultScore:
    """What became of epochs with a fault of one antenna."""

    epochs: int = 0
    found: int = 0
    passed: int = 0
    beyond_sigmas: int = 0
    beyond_levels: int = 0
    largest: float = 0.0

    def take(self, layout: Layout, edges: list[Edge], antenna: str, fault_ned_m: Vector, pose: Pose) -> None:
        """Judge one epoch with a fault put in."""
        measured = joint(layout, [_faulty(edge, antenna, fault_ned_m) for edge in edges])
        verdict = judged(layout, measured)
        self.epochs += 1
        self.found += verdict.finding is not Finding.OK
        if verdict.fit is None or verdict.integrity is not Integrity.OK:
            return
        self.passed += 1
        errors, sigmas = _errors_and_sigmas(verdict.fit, pose)
        bounds = levels(layout, measured, verdict, GUARDING).rad
        self.beyond_sigmas += bool(np.any(np.abs(errors) > _WITHIN * sigmas))
        self.beyond_levels += bool(np.any(np.abs(errors) > bounds))
        self.largest = max(self.largest, float(np.nanmax(np.abs(errors) / bounds)))

    def row(self) -> Row:
        """Return the figures."""
        epochs, passed = max(self.epochs, 1), max(self.passed, 1)
        shares = {"found_pct": self.found / epochs, "passed_pct": self.passed / epochs}
        shares |= {"beyond_sigmas_pct": self.beyond_sigmas / passed, "beyond_levels_pct": self.beyond_levels / passed}
        return {"epochs": self.epochs, **{name: 100.0 * share for name, share in shares.items()}, "largest": self.largest}


def _faulty(edge: Edge, antenna: str, fault_ned_m: Vector) -> Edge:
    sign = (edge.end == antenna) - (edge.start == antenna)
    return replace(edge, vector_ned_m=edge.vector_ned_m + sign * fault_ned_m)


def _errors_and_sigmas(fit: Fit, pose: Pose) -> tuple[Vector, Vector]:
    """Return errors and sigmas (rad) of heading, pitch, roll; sigmas that are not seen are NaN."""
    true = (pose.heading_rad, pose.pitch_rad, pose.roll_rad)
    errors = np.array([wrapped(found - told) for found, told in zip(fit.angles_rad, true, strict=True)])
    return errors, np.sqrt(np.diag(angles_covariance(fit, UNSEEN_RAD)))


def _normalised(fit: Fit, truth: Vector) -> float:
    """Return the squared error per degree of freedom, without the turn that antennas on a line do not see."""
    off = vector_of(truth @ fit.ned_from_body.T)
    seen = np.eye(3)
    if fit.unseen_ned is not None:
        seen = np.linalg.svd(fit.unseen_ned[None, :])[2][1:].T
    cov = seen.T @ fit.cov[:3, :3] @ seen
    return float((seen.T @ off) @ np.linalg.solve(cov, seen.T @ off)) / len(cov)


FaultKey = tuple[int, str, float]  # antennas, direction, size (m)


def run(rng: np.random.Generator, epochs: int, scores: dict[int, Score], faults: dict[FaultKey, FaultScore]) -> None:
    """Simulate and solve one run, and judge its epochs for two, three and four antennas, as they are and with a fault."""
    seed, start = int(rng.integers(2**31)), _FIRST + float(rng.integers(604800 - 3600))
    site = Site(radians(float(rng.uniform(-60.0, 60.0))), radians(float(rng.uniform(-180.0, 180.0))), 50.0)
    begun_s = absolute_s(start) - float(rng.uniform(0.0, 300.0))
    receivers = {
        name: Receiver(name, AntennaPath(site, lambda time_s: boat(time_s - begun_s), place), seed, _ON_A_BOAT)
        for name, place in PLACES.items()
    }
    sessions = {name: _session(PLACES["a"], PLACES[name], start, epochs * STEP_S) for name in ("b", "c", "d")}
    layout, all_fixed = Layout(tuple(PLACES), np.array(list(PLACES.values()))), False
    for k in range(epochs):
        observed = {name: receiver.observe(start + k * STEP_S) for name, receiver in receivers.items()}
        edges = {name: edge for name, s in sessions.items() if (edge := _edge(name, _solved(s, observed, name, k * STEP_S))) is not None}
        all_fixed = all_fixed or len(edges) == len(sessions)
        if all_fixed:
            pose = boat(absolute_s(start + k * STEP_S) - begun_s)  # baselines are of the instant that the tags name
            for count, names in ((2, "b"), (3, "bc"), (4, "bcd")):
                scores[count].take(layout, [edges[name] for name in names if name in edges], pose)
                if count > 2 and len(edges) == len(sessions):
                    _with_fault(layout, [edges[name] for name in names], pose, rng, faults)


def _with_fault(layout: Layout, edges: list[Edge], pose: Pose, rng: np.random.Generator, faults: dict[FaultKey, FaultScore]) -> None:
    """Judge an epoch once more, with a fault of a random antenna, size and direction."""
    count, angle, size_m = len(edges) + 1, rng.uniform(0.0, 2.0 * np.pi), float(rng.choice(SIZES_M))
    vertical = bool(rng.integers(2))
    direction = np.array([0.0, 0.0, 1.0]) if vertical else np.array([np.cos(angle), np.sin(angle), 0.0])
    score = faults.setdefault((count, "vertical" if vertical else "horizontal", size_m), FaultScore())
    score.take(layout, edges, str(rng.choice([*PLACES][:count])), size_m * direction, pose)


def _session(base: tuple[float, float, float], rover: tuple[float, float, float], start: GpsTime, seconds: float) -> Session:
    length_m = float(np.linalg.norm(np.array(rover) - np.array(base)))
    options = RtkOptions(mode=Mode.MOVING_BASE, baseline_length_m=length_m)
    session = Session(SessionOptions(options, pairing_for(options, replay=False, maximum_wait_s=0.1)))
    for time_ in (start, start + seconds):
        for satellite in SATELLITES.tolist():
            session.feed(Source.NAVIGATION, broadcast(satellite, time_))
    session.feed(Source.NAVIGATION, KLOBUCHAR)
    return session


def _solved(session: Session, observed: dict[str, Observed], rover: str, now_s: float) -> Solution | None:
    session.feed(Source.BASE, observed["a"].epoch, now_s)
    session.feed(Source.ROVER, observed[rover].epoch, now_s)
    return next(iter(session.solutions(now_s + 0.05)), None)


def _edge(name: str, solution: Solution | None) -> Edge | None:
    if solution is None or solution.status is not Status.FIX or solution.integrity is Integrity.FAILED:
        return None
    turn = NED_FROM_ENU @ enu_from_ecef_at(solution.base_ecef_m)
    return Edge("a", name, turn @ solution.baseline_ecef_m, turn @ solution.baseline_cov_ecef_m2 @ turn.T)


def measured(runs: int, epochs: int) -> tuple[list[Row], list[Row]]:
    """Return a row for two, three and four antennas, and rows of what faults did to three and four."""
    scores, faults = {count: Score() for count in (2, 3, 4)}, dict[FaultKey, FaultScore]()
    for seed in range(runs):
        run(np.random.default_rng(seed), epochs, scores, faults)
    of_faults = [{"antennas": key[0], "fault": key[1], "size_m": key[2]} | score.row() for key, score in sorted(faults.items())]
    return [score.row(count) for count, score in scores.items()], of_faults


def page(rows: list[Row], of_faults: list[Row]) -> str:
    """Return the tables as Markdown."""
    return "\n".join([table(COLUMNS, [_cells(row) for row in rows]), table(FAULTS, [_fault_cells(row) for row in of_faults])])


def _cells(row: Row) -> list[str]:
    angles = [f"{value:.3f}" if np.isfinite(value) else "" for value in row["rms_deg"]]
    counts = [str(row[name]) for name in ("excluded", "failed", "wrong")]
    publish = " / ".join(f"{value:.2f}" for value in row["publish_ms"])
    bounds = [" / ".join("" if np.isnan(value) else f"{value:.2f}" for value in row["levels_deg"]), str(row["beyond"])]
    shown = [str(row["antennas"]), str(row["epochs"]), f"{row['available_pct']:.2f}", *angles, f"{row['honesty']:.2f}", *counts]
    return [*shown, *bounds, publish]


def _fault_cells(row: Row) -> list[str]:
    shares = [f"{row[name]:.1f}" for name in ("found_pct", "passed_pct", "beyond_sigmas_pct", "beyond_levels_pct")]
    return [str(row["antennas"]), row["fault"], f"{1e3 * row['size_m']:.0f}", str(row["epochs"]), *shares, f"{row['largest']:.2f}"]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", help="not used: all is simulated")
    parser.add_argument("--quick", action="store_true", help="two runs instead of twenty")
    parser.add_argument("--json", action="store_true", help="all figures, for programs")
    options = parser.parse_args()
    rows, of_faults = measured(2 if options.quick else 20, 240)
    print(json.dumps({"clean": rows, "faults": of_faults}, indent=1) if options.json else page(rows, of_faults))
    return 0


if __name__ == "__main__":
    sys.exit(main())
