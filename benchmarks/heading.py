#!/usr/bin/env python3
"""How well a heading repeats: two survey antennas 0.99 m apart that stand still (recording tokyo_static), solved as a moving base.

  heading.py [--data DIR] [--quick] [--json]

Ours and RTKLIB's rnx2rtkp (`pos1-posmode=movingbase`) on the same files, per systems and frequencies: each epoch by itself
(instantaneous), and with ambiguities carried on (continuous). `length known`: the solver is told 0.990 m. Fixes in % of the epochs;
outliers are fixes more than 5 cm off the median baseline. Standard deviations are of the other fixes: azimuth and elevation in degrees,
length in mm. Five minutes of one recording: how it repeats, not how right it is.
"""

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import kernel_cache  # noqa: F401  first of all
import recorded
import rtklib
from cases import Case, data_folder, load
from results import table
from rtkmesh.gnss.frames import enu_from_ecef_at
from rtkmesh.rtk.options import AmbiguityMode, AmbiguityOptions, Mode, RtkOptions
from rtkmesh.rtk.solution import Solution, Status
from score_pos import FIX

Row = dict[str, Any]
Vector = NDArray[np.float64]

CASE: Final = "tokyo_static_l125"
LENGTH_M: Final = 0.990
VARIANTS: Final = (("GREJC", 3), ("GEJC", 2), ("GEJC", 1), ("G", 2), ("G", 1))
QUICK: Final = (("GEJC", 2), ("G", 1))
MODES: Final = (AmbiguityMode.INSTANTANEOUS, AmbiguityMode.CONTINUOUS)
COLUMNS: Final = ("systems, bands", "ambiguities", "solved by", "fix %", "outliers", "azimuth sd deg", "elevation sd deg", "length sd mm")
_OUTLIER_M: Final = 0.05


def ours(case: Case, systems: str, frequencies: int, mode: AmbiguityMode, length_m: float | None) -> Vector:
    """Return the fixed baselines (n, 3), east-north-up, of our solver."""
    options = RtkOptions(
        mode=Mode.MOVING_BASE, systems=systems, frequencies=frequencies, baseline_length_m=length_m, ambiguity=AmbiguityOptions(mode=mode)
    )
    return baselines_enu_m([s for s in recorded.solutions(case, options) if s.status is Status.FIX])


def baselines_enu_m(solutions: Sequence[Solution]) -> Vector:
    """Return the baselines (n, 3) in east-north-up at the first one's base."""
    if not solutions:
        return np.empty((0, 3))
    return np.array([s.baseline_ecef_m for s in solutions]) @ enu_from_ecef_at(solutions[0].base_ecef_m).T


def theirs(case: Case, systems: str, frequencies: int, mode: AmbiguityMode) -> Vector:
    """Return the same of rnx2rtkp."""
    track = rtklib.moving_base(case, systems, frequencies, mode.value)
    return track.vector_m[track.quality == FIX]


def figures(baseline_enu_m: Vector, epochs: int) -> Row:
    """Return how the fixed baselines (n, 3) repeat."""
    if not len(baseline_enu_m):
        return {"fix_pct": 0.0, "outliers": 0}
    off_m = np.linalg.norm(baseline_enu_m - np.median(baseline_enu_m, axis=0), axis=1)
    good = baseline_enu_m[off_m <= _OUTLIER_M]
    east, north, up = good.T
    azimuth = np.unwrap(np.arctan2(east, north))
    return {
        "fix_pct": 100.0 * len(baseline_enu_m) / epochs,
        "outliers": int(np.sum(off_m > _OUTLIER_M)),
        "azimuth_sd_deg": float(np.degrees(azimuth.std())),
        "elevation_sd_deg": float(np.degrees(np.arctan2(up, np.hypot(east, north)).std())),
        "length_sd_mm": float(1e3 * np.linalg.norm(good, axis=1).std()),
    }


def measured(case: Case, variants: Sequence[tuple[str, int]]) -> Iterator[Row]:
    """Yield one row per variant, mode and solver."""
    for systems, frequencies in variants:
        for mode in MODES:
            about = {"variant": f"{systems}, {frequencies}", "mode": mode.value}
            for name, length_m in (("rtkmesh", None), ("rtkmesh, length known", LENGTH_M)):
                yield about | {"solver": name} | figures(ours(case, systems, frequencies, mode, length_m), case.epochs)
            if not rtklib.missing():
                yield about | {"solver": "RTKLIB b34"} | figures(theirs(case, systems, frequencies, mode), case.epochs)


def page(rows: Sequence[Row]) -> str:
    """Return the table as Markdown."""
    return table(COLUMNS, [_cells(row) for row in rows])


def _cells(row: Row) -> list[str]:
    spread = [
        f"{row[name]:.{digits}f}" if name in row else ""
        for name, digits in (("azimuth_sd_deg", 4), ("elevation_sd_deg", 4), ("length_sd_mm", 2))
    ]
    return [row["variant"], row["mode"], row["solver"], f"{row['fix_pct']:.1f}", str(row["outliers"]), *spread]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of the recordings")
    parser.add_argument("--quick", action="store_true", help="two variants")
    parser.add_argument("--json", action="store_true", help="all figures, for programs")
    options = parser.parse_args()
    data = options.data or data_folder()
    if data is None:
        print("heading: no recordings: set RTKMESH_DATA or give --data", file=sys.stderr)
        return 2
    rows = list(measured(load(data, [CASE])[0], QUICK if options.quick else VARIANTS))
    print(json.dumps(rows, indent=1) if options.json else page(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
