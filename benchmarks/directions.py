#!/usr/bin/env python3
"""Forward, backward and combined on the same recordings, rtkmesh beside RTKLIB's rnx2rtkp (-b, -c) in the same run.

  directions.py [--data DIR] [--only NAME,...] [--quick] [--json] [--gate] [--keep DIR]

As accuracy.py, once per direction. right / wrong: right fixes in % of the rover's epochs (of those that the reference covers) and number
of wrong ones; h95, v95: errors of fixes in metres; ms per epoch: ours the wall time of solving, both directions together, RTKLIB's the
processor time of the process. `how`: how many epochs were combined how (rtkmesh.rtk.combination.How).

--gate ends with 1 where the combined solution has more wrong fixes than the forward one.
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Final

import rtklib
from accuracy import OURS, RTKLIB, Row, ours, theirs
from cases import QUICK, Case, data_folder, load
from results import table

DIRECTIONS: Final = ("forward", "backward", "combined")
COLUMNS: Final = ("recording", "program", "direction", "fix %", "right %", "wrong", "h95 m", "v95 m", "first fix s", "ms", "how")
_PROGRAM: Final = [sys.executable, "-m", "rtkmesh_services.cli.main"]

Rows = dict[str, dict[str, Row]]  # program, direction


def measure(case: Case, out: Path) -> Rows:
    """Return the rows of a case by program and direction."""
    rows: Rows = {OURS: {way: ours(_PROGRAM, case, out / f"{case.name}.{way}.pos", way) for way in DIRECTIONS}}
    if not rtklib.missing():
        rows[RTKLIB] = {way: theirs(case, out / f"{case.name}.{way}.b34.pos", way) for way in DIRECTIONS}
    return rows


def cells(case: Case, program: str, way: str, row: Row) -> list[str]:
    """Return a row of the table."""
    if "failed" in row:
        return [case.name, program, way, "FAILED", row["failed"], *[""] * 6]
    judged = "right_fix_pct" in row
    right = [f"{row['right_fix_pct']:.2f}", str(row["wrong_fixes"])] if judged else ["", ""]
    errors = [f"{row[f'{axis}_fixed']['p95']:.3f}" for axis in ("h", "v")] if judged and row["h_fixed"] else ["", ""]
    how = ", ".join(f"{name.replace('_', ' ')} {count}" for name, count in row.get("combined", {}).items())
    first = "" if row["ttff_s"] is None else f"{row['ttff_s']:.0f}"
    cost_ms = row.get("solve_ms_per_epoch", row["cpu_ms_per_epoch"])
    return [case.name, program, way, f"{row['fix_pct']:.2f}", *right, *errors, first, f"{cost_ms:.2f}", how]


def more_wrong(report: dict[str, Rows]) -> list[str]:
    """Return where the combined solution has more wrong fixes than the forward one."""
    found = (
        (name, rows[OURS]["forward"].get("wrong_fixes", 0), rows[OURS]["combined"].get("wrong_fixes", 0)) for name, rows in report.items()
    )
    return [f"{name}: {combined} wrong fixes combined, {forward} forward" for name, forward, combined in found if combined > forward]


def main() -> int:
    options = _options()
    data = options.data or data_folder()
    if data is None:
        print("directions: no recordings: set RTKMESH_DATA or give --data", file=sys.stderr)
        return 2
    try:
        cases = load(data, options.only.split(",") if options.only else list(QUICK) if options.quick else None)
    except KeyError as error:
        print(f"directions: there is no case {error}", file=sys.stderr)
        return 2
    rtklib.run([*_PROGRAM, "warm", "--json"])  # compiling is not what is measured
    report: dict[str, Rows] = {}
    with tempfile.TemporaryDirectory(prefix="rtkmesh_directions_") as folder:
        out = options.keep or Path(folder)
        out.mkdir(parents=True, exist_ok=True)
        for case in cases:
            report[case.name] = measure(case, out)
            print(f"{case.name} done", file=sys.stderr, flush=True)
    lines = [cells(case, program, way, row) for case in cases for program, ways in report[case.name].items() for way, row in ways.items()]
    print(json.dumps(report, indent=1) if options.json else table(COLUMNS, lines))
    behind = more_wrong(report)
    for line in behind:
        print(f"behind: {line}", file=sys.stderr)
    failed = any("failed" in row for rows in report.values() for row in rows[OURS].values())
    return int(failed or (options.gate and bool(behind)))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of the recordings")
    parser.add_argument("--only", help="names of cases, with commas between")
    parser.add_argument("--quick", action="store_true", help="the short recordings only")
    parser.add_argument("--json", action="store_true", help="all figures, for programs")
    parser.add_argument("--gate", action="store_true", help="end with 1 where combining makes more fixes wrong")
    parser.add_argument("--keep", type=Path, help="folder for the .pos files")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
