#!/usr/bin/env python3
"""A million updates of one filter: does every covariance stay positive definite, without a reset?

  endurance.py [--updates N] [--seed S] [--quick] [--json]

One band of GPS above 30 degrees at 10 Hz, day and night, so that satellites come and go as they do. Nine microseconds of every update are
the check. The test suite does the same for five minutes.
"""

import argparse
import json
import sys
from dataclasses import replace
from math import radians
from typing import Any, Final

import numpy as np
from rich.console import Console
from rich.progress import track

import kernel_cache  # noqa: F401  first of all
from results import table
from rtkmesh.gnss.time import GpsTime
from rtkmesh.models.ephemeris_table import EphemerisTable
from rtkmesh.rtk.engine import Rtk
from rtkmesh.rtk.options import RtkOptions
from rtkmesh.rtk.solution import Solution, Status
from rtkmesh.simulation.classes import F9P, SURVEY
from rtkmesh.simulation.receiver import Receiver
from rtkmesh.simulation.sky import KLOBUCHAR, SATELLITES, broadcast
from rtkmesh.simulation.trajectories import AntennaPath, Site, driving

UPDATES: Final = 1_000_000
QUICK_UPDATES: Final = 20_000
_START: Final = GpsTime(2445, 0.0)
_STEP_S: Final = 0.1
_ISSUE_S: Final = 1800.0  # new ephemerides are given this often
_SITE: Final = Site(radians(47.0), radians(8.0), 400.0)
_OPTIONS: Final = RtkOptions(frequencies=1, systems="G", elevation_mask_rad=radians(30.0))
_WRONG_M: Final = 0.15


def smallest_eigenvalue_ratio(solution: Solution) -> float:
    """Return the smallest over the largest eigenvalue of the worse of the covariances of position and velocity; negative is broken."""
    ratios: list[float] = []
    for cov in (solution.position_cov_ecef_m2, solution.velocity_cov_ecef_m2ps2):
        values = np.linalg.eigvalsh(cov)
        ratios.append(float(values[0] / values[-1]))
    return min(ratios)


def endure(updates: int, seed: int) -> dict[str, Any]:
    """Run that many updates and return what became of them."""
    rover = Receiver("rover", AntennaPath(_SITE, driving, (0.0, 0.0, -1.5)), seed, replace(F9P, systems="G", frequencies=1))
    base = Receiver("base", AntennaPath(_SITE, None, (-320.0, 210.0, 4.0)), seed, replace(SURVEY, steered=True, systems="G", frequencies=1))
    table_, engine, solution = EphemerisTable(), Rtk(_OPTIONS), Solution(_START)
    counts, worst, broken, wrong = dict.fromkeys(("FIX", "FLOAT", "other"), 0), 1.0, 0, 0
    console = Console(stderr=True)
    for k in track(range(updates), "updates", console=console, disable=not sys.stderr.isatty()):
        time = _START + _STEP_S * k
        if k % round(_ISSUE_S / _STEP_S) == 0:
            for satellite in SATELLITES.tolist():
                table_.add(broadcast(satellite, time))
        seen, other = rover.observe(time), base.observe(time)
        solution = engine.step(seen.epoch, other.epoch, table_, KLOBUCHAR, base_position_ecef_m=other.position_ecef_m)
        relative = solution.status in (Status.FIX, Status.FLOAT)
        counts[solution.status.name if relative else "other"] += 1
        if relative:
            ratio = smallest_eigenvalue_ratio(solution)
            worst, broken = min(worst, ratio), broken + (not ratio > 0.0)
            off_m = float(np.linalg.norm(solution.position_ecef_m - seen.position_ecef_m))
            wrong += solution.status is Status.FIX and off_m > _WRONG_M
    return {"updates": updates, **counts, "wrong_fixes": wrong, "resets": solution.resets, "broken": broken, "smallest_ratio": worst}


def page(row: dict[str, Any]) -> str:
    """Return the figures as a Markdown table."""
    columns = (
        "updates",
        "fix",
        "float",
        "no relative solution",
        "wrong fixes",
        "resets",
        "covariances not positive",
        "smallest eigenvalue ratio",
    )
    return table(columns, [[f"{value:.2e}" if isinstance(value, float) else str(value) for value in row.values()]])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--updates", type=int, default=0, help=f"default {UPDATES}")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--quick", action="store_true", help=f"{QUICK_UPDATES} updates")
    parser.add_argument("--json", action="store_true", help="all figures, for programs")
    parser.add_argument("--data", help="not needed: everything is simulated")
    options = parser.parse_args()
    row = endure(options.updates or (QUICK_UPDATES if options.quick else UPDATES), options.seed)
    print(json.dumps(row, indent=1) if options.json else page(row))
    return int(row["broken"] > 0)


if __name__ == "__main__":
    sys.exit(main())
