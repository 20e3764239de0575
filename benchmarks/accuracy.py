#!/usr/bin/env python3
"""Our solutions beside RTKLIB's on the same recordings, in the same run.

  accuracy.py [--data DIR] [--only NAME,...] [--quick] [--direction WAY] [--json] [--markdown] [--gate] [--keep DIR]

Every pair of cases.toml (RTKMESH_DATA or ../shared/data) is solved by `rtkmesh solve` with the flags that the case names and by
RTKLIB's rnx2rtkp with the options beside the data; both files are scored by score_pos.py, and so are the stored solutions of demo5
('rec': with its usual options). rnx2rtkp gets RINEX: what convbin needs before is not counted, what rtkmesh needs to decode the log is.

Columns: solutions, fixes and right fixes in % of the rover's epochs (of those that the reference covers), wrong fixes (off by more
than 0.15 m in 3D) and the longest run of them, errors of the fixes (50 % / 95 %), time to first fix, processor time per epoch of the
whole process (start included), and of the solving alone. `Where both fix`: errors (95 %) at the epochs that we and rnx2rtkp have fixed, and
their number; what one of them fixes alone has no part in it. `own median`: there is no truth, the errors are about the file's own median
fix and say only how well it repeats.

--gate ends with 1 when a case has fewer right fixes than rnx2rtkp by 2 % of the epochs, or more wrong ones.
"""

import argparse
import json
import shlex
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

import rtklib
from cases import QUICK, Case, data_folder, load
from results import README, RESULTS, accuracy_page, accuracy_summary, fill

Row = dict[str, Any]
Report = dict[str, dict[str, Row]]

OURS, RTKLIB = "rtkmesh", "b34"
TITLES = {OURS: "rtkmesh", RTKLIB: "RTKLIB 2.4.3 b34", "demo5": "demo5 2.5.1, stored", "demo5_rec": "demo5 rec, stored"}
_PROGRAM = [sys.executable, "-m", "rtkmesh_services.cli.main"]
_GATE_PCT = 2.0


def ours(program: list[str], case: Case, out: Path, direction: str = "forward", *flags: str) -> Row:
    """Solve a case with rtkmesh, with further ``flags``, and return its scored row."""
    argv = [*program, "solve", "--rover", str(case.rover), "--base", str(case.base)]
    for file in case.navigation:
        argv += ["--nav", str(file)]
    argv += ["--frequencies", str(case.frequencies), "--systems", case.systems, "--elmask", "15"]
    argv += ["--direction", direction] if direction != "forward" else []
    argv += ["--base-ecef=" + ",".join(map(str, case.base_ecef_m)), "--format", "xyz", "--out", str(out), "--json", *flags]
    if case.date:
        argv += ["--date", case.date]
    try:
        done = rtklib.run(argv)
    except rtklib.ProgramError as error:
        return {"failed": str(error)}
    summary = json.loads(done.output)
    how = {"combined": summary["combined"]} if "combined" in summary else {}
    return case.score(out) | _cost(done, case) | {"solve_ms_per_epoch": summary["solve_ms_per_epoch"]} | how


def theirs(case: Case, out: Path, direction: str = "forward", further: str = "") -> Row:
    """Solve a case with rnx2rtkp, with ``further`` lines of options, and return its scored row."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            done = rtklib.solve(case, Path(folder), out, direction, further)
        except rtklib.ProgramError as error:
            return {"failed": str(error)}
    return case.score(out) | _cost(done, case)


def _cost(done: rtklib.Finished, case: Case) -> Row:
    per_epoch = 1e3 / case.epochs
    return {"wall_s": round(done.wall_s, 2), "cpu_s": round(done.cpu_s, 2), "cpu_ms_per_epoch": round(done.cpu_s * per_epoch, 3)}


def measure(case: Case, program: list[str], out: Path, direction: str = "forward") -> dict[str, Row]:
    """Return the rows of a case; one that could not be made has the key ``failed``. Stored solutions are forward ones."""
    mine, bar = out / f"{case.name}.rtkmesh.pos", out / f"{case.name}.b34.pos"
    rows = {OURS: ours(program, case, mine, direction)}
    if not rtklib.missing():
        rows[RTKLIB] = theirs(case, bar, direction)
        rows[OURS]["common"], rows[RTKLIB]["common"] = case.score_common(mine, bar), case.score_common(bar, mine)
    stored = case.stored if direction == "forward" else {}
    return rows | {name: case.score(file) for name, file in stored.items() if name != RTKLIB}


def in_words(row: Row) -> str:
    """Return a row as one line."""
    if "failed" in row:
        return "FAILED " + row["failed"]
    parts = [f"{row['solutions']:5d} solutions", f"fix {row['fix_pct']:6.2f} %"]
    if "right_fix_pct" in row:
        parts.append(f"right {row['right_fix_pct']:6.2f} %")
        parts.append(f"wrong {row['wrong_fixes']:4d} (run {row['longest_wrong_run']})")
        if row["h_fixed"]:
            parts += [f"{axis} {row[f'{axis}_fixed']['p50']:.3f}/{row[f'{axis}_fixed']['p95']:.3f}" for axis in ("h", "v")]
    if common := row.get("common"):
        parts.append(f"both fixed: {common['count']}, h {common['h']['p95']:.3f} v {common['v']['p95']:.3f}")
    parts.append(f"first fix {row['ttff_s']} s")
    if "cpu_ms_per_epoch" in row:
        parts.append(f"{row['cpu_ms_per_epoch']:.2f} ms/epoch")
    if "solve_ms_per_epoch" in row:
        parts.append(f"(solving {row['solve_ms_per_epoch']:.2f})")
    return "  ".join(parts)


def shortfalls(report: Report) -> list[str]:
    """Return where we are behind rnx2rtkp of the same run."""
    lines: list[str] = []
    for name, rows in report.items():
        mine, bar = rows[OURS], rows.get(RTKLIB, {})
        if "failed" in mine:
            lines.append(f"{name}: {mine['failed']}")
        elif "right_fix_pct" in mine and "right_fix_pct" in bar:
            if mine["right_fix_pct"] < bar["right_fix_pct"] - _GATE_PCT:
                lines.append(f"{name}: {mine['right_fix_pct']} % right fixes, rnx2rtkp {bar['right_fix_pct']} %")
            if mine["wrong_fixes"] > bar["wrong_fixes"]:
                lines.append(f"{name}: {mine['wrong_fixes']} wrong fixes, rnx2rtkp {bar['wrong_fixes']}")
    return lines


def main() -> int:
    options = _options()
    data = options.data or data_folder()
    if data is None:
        print("accuracy: no recordings: set RTKMESH_DATA or give --data", file=sys.stderr)
        return 2
    try:
        cases = load(data, _names(options))
    except KeyError as error:
        print(f"accuracy: there is no case {error}", file=sys.stderr)
        return 2
    if rtklib.missing():
        print(f"accuracy: without RTKLIB ({', '.join(rtklib.missing())} not installed): stored solutions only", file=sys.stderr)
    program = shlex.split(options.program) or _PROGRAM
    rtklib.run([*program, "warm", "--json"])  # compiling is not what is measured
    report = _measured(cases, program, options)
    behind = shortfalls(report)
    if options.json:
        print(json.dumps(report, indent=1))
    if options.markdown:
        fill(RESULTS, "accuracy", accuracy_page(report, cases, TITLES))
        fill(README, "results", accuracy_summary(report, cases, TITLES, behind))
    for line in behind:
        print(f"behind: {line}", file=sys.stderr)
    failed = any("failed" in rows[OURS] for rows in report.values())
    return int(failed or (options.gate and bool(behind)))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of the recordings")
    parser.add_argument("--only", help="names of cases, with commas between")
    parser.add_argument("--quick", action="store_true", help="the short recordings only")
    parser.add_argument("--direction", default="forward", choices=("forward", "backward", "combined"), help="of both programs")
    parser.add_argument("--json", action="store_true", help="all figures, for programs")
    parser.add_argument("--markdown", action="store_true", help="write the tables into benchmarks/RESULTS.md and README.md")
    parser.add_argument("--gate", action="store_true", help="end with 1 where we are behind rnx2rtkp")
    parser.add_argument("--keep", type=Path, help="folder for the .pos files")
    parser.add_argument("--program", default="", help="another rtkmesh to measure (default: of this interpreter)")
    options = parser.parse_args()
    if options.markdown and (options.only or options.quick or options.direction != "forward"):
        parser.error("--markdown writes the table of all cases, forward: leave out --only, --quick and --direction")
    return options


def _names(options: argparse.Namespace) -> list[str] | None:
    return options.only.split(",") if options.only else list(QUICK) if options.quick else None


def _measured(cases: list[Case], program: list[str], options: argparse.Namespace) -> Report:
    """Measure all cases, printing rows as they come."""
    out = options.keep or Path(tempfile.mkdtemp(prefix="rtkmesh_accuracy_"))
    out.mkdir(parents=True, exist_ok=True)
    report: Report = {}
    try:
        for case in cases:
            report[case.name] = measure(case, program, out, options.direction)
            for name, row in report[case.name].items():
                print(f"{case.name:18} {name:10} {in_words(row)}", file=sys.stderr if options.json else sys.stdout, flush=True)
    finally:
        if options.keep is None:
            shutil.rmtree(out)
    return report


if __name__ == "__main__":
    sys.exit(main())
