#!/usr/bin/env python3
"""Attitude of two, three and four antennas on a simulated boat, against the truth: moving bases, one rigid body, one verdict.

  attitude.py [--quick] [--json]

A boat of 2 by 1.2 m on waves at 2 Hz, at random places and times; receivers of F9P class with multipath and slips. Errors are root
mean squares of the attitudes that passed their test; honesty is the mean of squared errors over what their covariance says (1: exact,
above: too sure); wrong: passed, and off by more than 5 sigmas and 1 degree in any angle. Available: share of epochs after the first fix
of all baselines. `publish ms`: from the last baseline's solution to the attitude, judged (median, 99 %), on this machine.
"""

import argparse
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from math import radians
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import kernel_cache  # noqa: F401  first of all
from results import table
from rtkmesh.attitude.integrity import judged
from rtkmesh.attitude.joint import Edge, angles_covariance, joint
from rtkmesh.attitude.rigid_body import Fit, Layout
from rtkmesh.attitude.rotation import NED_FROM_ENU, rotation_of_angles, vector_of, wrapped
from rtkmesh.gnss.frames import enu_from_ecef_at
from rtkmesh.gnss.integrity import Integrity
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.options import Mode, RtkOptions
from rtkmesh.rtk.session import Session, SessionOptions, Source, pairing_for
from rtkmesh.rtk.solution import Solution, Status
from rtkmesh.simulation.classes import F9P
from rtkmesh.simulation.receiver import Observed, Receiver
from rtkmesh.simulation.sky import KLOBUCHAR, SATELLITES, absolute_s, broadcast
from rtkmesh.simulation.trajectories import AntennaPath, Pose, Site, boat

Vector = NDArray[np.float64]
Row = dict[str, Any]

PLACES: Final = {"a": (-1.0, -0.6, -2.0), "b": (1.0, -0.6, -2.0), "c": (-1.0, 0.6, -2.0), "d": (1.0, 0.6, -2.0)}
COLUMNS: Final = (
    "antennas", "epochs", "available %", "heading deg", "pitch deg", "roll deg", "honesty", "excluded", "failed", "wrong", "publish ms",
)  # fmt: skip
STEP_S: Final = 0.5
UNSEEN_RAD: Final = radians(10.0)
_WRONG_SIGMAS, _WRONG_RAD = 5.0, radians(1.0)
_FIRST: Final = GpsTime(2445, 0.0)


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
    took_ms: list[float] = field(default_factory=list[float])

    def take(self, layout: Layout, edges: list[Edge], pose: Pose) -> None:
        """Judge one epoch's baselines; none at all is an epoch without an attitude."""
        self.epochs += 1
        if not edges:
            return
        begun = time.perf_counter()
        verdict = judged(layout, joint(layout, edges))
        self.took_ms.append((time.perf_counter() - begun) * 1e3)
        self.failed += verdict.integrity is Integrity.FAILED
        self.excluded += bool(verdict.excluded)
        if verdict.fit is not None and verdict.integrity is Integrity.OK:
            self._passed(verdict.fit, pose)

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
            "publish_ms": np.percentile(self.took_ms, (50, 99)).tolist() if self.took_ms else [],
        }

    def _passed(self, fit: Fit, pose: Pose) -> None:
        self.passed += 1
        true = (pose.heading_rad, pose.pitch_rad, pose.roll_rad)
        cov = angles_covariance(fit, UNSEEN_RAD)
        seen = np.isfinite(np.diag(cov))
        errors = np.array([wrapped(found - told) for found, told in zip(fit.angles_rad, true, strict=True)])
        self.errors_rad.append(np.where(seen, errors, np.nan).tolist())
        self.normalised.append(_normalised(fit, rotation_of_angles(*true)))
        sigmas = np.sqrt(np.diag(cov))
        self.wrong += bool(np.any(np.abs(errors[seen]) > np.maximum(_WRONG_SIGMAS * sigmas[seen], _WRONG_RAD)))


def _normalised(fit: Fit, truth: Vector) -> float:
    """Return the squared error per degree of freedom, without the turn that antennas on a line do not see."""
    off = vector_of(truth @ fit.ned_from_body.T)
    seen = np.eye(3)
    if fit.unseen_ned is not None:
        seen = np.linalg.svd(fit.unseen_ned[None, :])[2][1:].T
    cov = seen.T @ fit.cov[:3, :3] @ seen
    return float((seen.T @ off) @ np.linalg.solve(cov, seen.T @ off)) / len(cov)


def run(rng: np.random.Generator, epochs: int, scores: dict[int, Score]) -> None:
    """Simulate and solve one run, and judge its epochs for two, three and four antennas."""
    seed, start = int(rng.integers(2**31)), _FIRST + float(rng.integers(604800 - 3600))
    site = Site(radians(float(rng.uniform(-60.0, 60.0))), radians(float(rng.uniform(-180.0, 180.0))), 50.0)
    begun_s = absolute_s(start) - float(rng.uniform(0.0, 300.0))
    receivers = {
        name: Receiver(name, AntennaPath(site, lambda time_s: boat(time_s - begun_s), place), seed, F9P) for name, place in PLACES.items()
    }
    sessions = {name: _session(PLACES["a"], PLACES[name], start, epochs * STEP_S) for name in ("b", "c", "d")}
    layout, all_fixed = Layout(tuple(PLACES), np.array(list(PLACES.values()))), False
    for k in range(epochs):
        observed = {name: receiver.observe(start + k * STEP_S) for name, receiver in receivers.items()}
        edges = {name: edge for name, s in sessions.items() if (edge := _edge(name, _solved(s, observed, name, k * STEP_S))) is not None}
        all_fixed = all_fixed or len(edges) == len(sessions)
        if all_fixed:
            pose = boat(absolute_s(observed["a"].true_time) - begun_s)
            for count, names in ((2, "b"), (3, "bc"), (4, "bcd")):
                scores[count].take(layout, [edges[name] for name in names if name in edges], pose)


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


def measured(runs: int, epochs: int) -> Iterator[Row]:
    """Yield a row for two, three and four antennas."""
    scores = {count: Score() for count in (2, 3, 4)}
    for seed in range(runs):
        run(np.random.default_rng(seed), epochs, scores)
    yield from (score.row(count) for count, score in scores.items())


def page(rows: list[Row]) -> str:
    """Return the table as Markdown."""
    return table(COLUMNS, [_cells(row) for row in rows])


def _cells(row: Row) -> list[str]:
    angles = [f"{value:.3f}" if np.isfinite(value) else "" for value in row["rms_deg"]]
    counts = [str(row[name]) for name in ("excluded", "failed", "wrong")]
    publish = " / ".join(f"{value:.2f}" for value in row["publish_ms"])
    return [str(row["antennas"]), str(row["epochs"]), f"{row['available_pct']:.2f}", *angles, f"{row['honesty']:.2f}", *counts, publish]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", help="not used: all is simulated")
    parser.add_argument("--quick", action="store_true", help="two runs instead of twenty")
    parser.add_argument("--json", action="store_true", help="all figures, for programs")
    options = parser.parse_args()
    rows = list(measured(2 if options.quick else 20, 240))
    print(json.dumps(rows, indent=1) if options.json else page(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
