#!/usr/bin/env python3
"""What a base epoch that is 0.2 s old does to a heading: the experiment of figure 5 of the rtkrcv_ros paper, on the simulator.

  attitude_age.py [--quick] [--json]

A boat with antennas 0.70 m apart goes round at 1 m/s and yaws. Rover epochs come once a second, base epochs of the other antenna at the
same instants, or 0.2 s before. Ours and RTKLIB's rnx2rtkp (`movingbase`) get the same bytes of both receivers. Errors are of the heading
of fixes against the truth, degrees. Ours pairs equal instants only: of an old base it makes no heading.
"""

import argparse
import json
import sys
import tempfile
from collections.abc import Iterator
from math import pi, sin
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import kernel_cache  # noqa: F401  first of all
import rtklib
from heading import baselines_enu_m
from results import table
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.options import Mode, RtkOptions
from rtkmesh.rtk.session import SessionOptions, pairing_for
from rtkmesh.rtk.solution import Status
from rtkmesh.simulation.scenario import SCENARIOS, Antenna, Scenario, open_stream, truth
from rtkmesh.simulation.trajectories import Pose
from rtkmesh_services.cli.offline import Run, open_inputs
from score_pos import FIX, read_track

Row = dict[str, Any]
Vector = NDArray[np.float64]

LENGTH_M: Final = 0.70
RADIUS_M, SPEED_MPS = 30.0, 1.0
RATE_HZ: Final = 5
SEED: Final = 1
START: Final = GpsTime(2445, 200000.0)
BASES: Final = {"the same instant": 0, "0.2 s before": RATE_HZ - 1}
COLUMNS: Final = ("base epochs", "solved by", "rover epochs", "fix %", "heading rms deg", "heading worst deg")
_GPS_WEEK_S: Final = 604800.0


def round_and_round(time_s: float) -> Pose:
    """Circle at 1 m/s, yawing by 10 degrees every 6 s."""
    turn = SPEED_MPS / RADIUS_M * time_s
    heading = (turn + 0.17 * sin(2.0 * pi * time_s / 6.0)) % (2.0 * pi)
    return Pose((-RADIUS_M * np.cos(turn), RADIUS_M * np.sin(turn), 0.0), heading, 0.02 * sin(time_s), 0.05 * sin(1.3 * time_s))


def scenario() -> Scenario:
    """Return the boat of the paper: the receivers of the simulated boat, 0.70 m apart along it."""
    like = SCENARIOS["boat"]
    places = {"rover": (0.5 * LENGTH_M, 0.0, -1.0), "heading": (-0.5 * LENGTH_M, 0.0, -1.0)}
    return Scenario(like.site, round_and_round, {name: Antenna(place, like.antennas[name].options) for name, place in places.items()})


def record(folder: Path, seconds: int) -> dict[str, Path]:
    """Write what both receivers send: the rover once a second, the base then and before, and all of the rover for ephemerides."""
    SCENARIOS["paper_boat"] = scenario()
    parts: dict[str, list[bytes]] = {name: [] for name in ("rover", "all", *BASES)}
    streams = [open_stream("paper_boat", name, seed=SEED, rate_hz=float(RATE_HZ), start=START).epochs() for name in ("rover", "heading")]
    for k in range(seconds * RATE_HZ):
        rover, base = (next(stream).data for stream in streams)
        parts["all"].append(rover)
        if k % RATE_HZ == 0:
            parts["rover"].append(rover)
        for name, phase in BASES.items():
            if k % RATE_HZ == phase:
                parts[name].append(base)
    paths = {name: folder / f"{name.replace(' ', '_').replace('.', '')}.ubx" for name in parts}
    for name, path in paths.items():
        path.write_bytes(b"".join(parts[name]))
    return paths


def ours(rover: Path, base: Path, navigation: Path) -> tuple[Vector, Vector]:
    """Return times (GPS seconds) and baselines (n, 3; ENU) of the fixes of our solver."""
    options = RtkOptions(mode=Mode.MOVING_BASE)
    session = SessionOptions(options, pairing_for(options, replay=True), None, navigation_streams=1)
    fixes = [s for s in Run(open_inputs(rover, base, (navigation,), None), session).solutions() if s.status is Status.FIX]
    return np.array([s.time.week * _GPS_WEEK_S + s.time.tow_s for s in fixes]), baselines_enu_m(fixes)


def theirs(rover: Path, base: Path, navigation: Path, folder: Path) -> tuple[Vector, Vector]:
    """Return the same of rnx2rtkp."""
    conf, out = folder / "age.conf", folder / "age.pos"
    conf.write_text(rtklib.plain_options("movingbase", "GREJC", 2, "continuous") + "out-solformat=enu\n")
    rtklib.run(["rnx2rtkp", "-k", str(conf), "-o", str(out), str(rover), str(base), str(navigation)])
    track = read_track(out)
    fixed = track.quality == FIX
    return track.time_s[fixed], track.vector_m[fixed]


def figures(times_s: Vector, baselines: Vector, epochs: int) -> Row:
    """Return how far the headings are off."""
    if not len(times_s):
        return {"fix_pct": 0.0}
    at = truth("paper_boat", seed=SEED)
    true = np.array([at(GpsTime.normalized(0, float(time_s))).heading_rad for time_s in times_s])
    off = np.degrees((np.arctan2(baselines[:, 0], baselines[:, 1]) - true + pi) % (2.0 * pi) - pi)
    return {"fix_pct": 100.0 * len(off) / epochs, "rms_deg": float(np.sqrt(np.mean(off**2))), "worst_deg": float(np.abs(off).max())}


def measured(seconds: int) -> Iterator[Row]:
    """Yield a row per base and solver."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        files = record(folder, seconds)
        converted = {} if rtklib.missing() else {name: rtklib.converted(path, folder) for name, path in files.items()}
        for base in BASES:
            about = {"base": base, "epochs": seconds}
            yield about | {"solver": "rtkmesh"} | figures(*ours(files["rover"], files[base], files["all"]), seconds)
            if converted:
                found = theirs(converted["rover"][0], converted[base][0], converted["all"][1][0], folder)
                yield about | {"solver": "RTKLIB b34"} | figures(*found, seconds)


def page(rows: list[Row]) -> str:
    """Return the table as Markdown."""
    return table(COLUMNS, [_cells(row) for row in rows])


def _cells(row: Row) -> list[str]:
    errors = [f"{row[name]:.2f}" if name in row else "" for name in ("rms_deg", "worst_deg")]
    return [row["base"], row["solver"], str(row["epochs"]), f"{row['fix_pct']:.1f}", *errors]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", help="not used: all is simulated")
    parser.add_argument("--quick", action="store_true", help="two minutes instead of ten")
    parser.add_argument("--json", action="store_true", help="all figures, for programs")
    options = parser.parse_args()
    rows = list(measured(120 if options.quick else 600))
    print(json.dumps(rows, indent=1) if options.json else page(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
