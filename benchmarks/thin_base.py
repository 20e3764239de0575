#!/usr/bin/env python3
"""A base every 5, 15 or 30 s under a rover at 1 Hz, with and without interpolation, rtkmesh beside RTKLIB's rnx2rtkp in the same run.

  thin_base.py [--data DIR] [--only NAME,...] [--intervals 5,15,30] [--quick] [--json] [--keep DIR]

The base of each recording is thinned to one epoch in so many seconds (as RINEX, the same file for both programs; flags of epochs that
are left out are lost, as they are where a station records no faster) and solved forward as accuracy.py does it. `interpolated`: rtkmesh
solve as it is, and with --no-interpolation; rnx2rtkp with misc-timeinterp=on and off. right / wrong: right fixes in % of the rover's
epochs (of those that the reference covers) and number of wrong ones; h95, v95: errors of fixes in mm. `-`: the base as recorded.
"""

import argparse
import json
import re
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Final

import rtklib
from accuracy import OURS, RTKLIB, Row, ours, theirs
from cases import Case, data_folder, load
from results import table

RECORDINGS: Final = (
    "tokyo_static_l125", "tokyo_static_l1gps", "galway_a", "galway_b_walk", "umea_r001", "stromlo_l12", "stromlo_l125", "yamatogawa_walk",
    "galway_a_glw1", "galway_b_glw1",
)  # fmt: skip
QUICK: Final = ("tokyo_static_l125", "yamatogawa_walk")
INTERVALS_S: Final = (5, 15, 30)
COLUMNS: Final = ("recording", "base every s", "program", "interpolated", "fix %", "right %", "wrong", "h95 mm", "v95 mm")
_PROGRAM: Final = [sys.executable, "-m", "rtkmesh_services.cli.main"]
# The line that begins an epoch, of RINEX 3 and 2, with its seconds of the minute.
_EPOCH: Final = re.compile(r"> \d{4}(?: [ \d]\d){4} ?([ \d]\d\.\d{7})|[ \d]{3}(?: [ \d]\d){4} ([ \d]\d\.\d{7})  [01]")

Rows = dict[str, dict[str, dict[str, Row]]]  # interval, program, interpolated or not


def thinned(rinex: str, interval_s: int) -> str:
    """Return RINEX observations with the epochs alone whose seconds are whole multiples of an interval that divides a minute."""
    header, end, body = rinex.partition("END OF HEADER")
    first, *lines = body.splitlines(keepends=True)
    kept, keeps = [header, end, first], True
    for line in lines:
        if found := _EPOCH.match(line):
            seconds = float(found[1] or found[2])
            keeps = abs(seconds - interval_s * round(seconds / interval_s)) < 0.1
        if keeps:
            kept.append(line)
    return "".join(kept)


def with_thin_base(case: Case, interval_s: int, folder: Path) -> Case:
    """Return the case with a base of one epoch in ``interval_s``, with what navigation data its recording had."""
    _, base, *navigation = rtklib.rinex(case, folder)
    thin = folder / f"{base.stem}_{interval_s}s.obs"
    thin.write_text(thinned(base.read_text(), interval_s))
    return replace(case, base=thin, navigation=tuple(dict.fromkeys((*case.navigation, *navigation))))


def measure(case: Case, out: Path) -> dict[str, dict[str, Row]]:
    """Return the rows of a case by program, with and without interpolation."""
    mine = {"yes": ours(_PROGRAM, case, out / "yes.pos"), "no": ours(_PROGRAM, case, out / "no.pos", "forward", "--no-interpolation")}
    bar = {word: theirs(case, out / f"{word}.b34.pos", further=f"misc-timeinterp={value}\n") for word, value in (("yes", 1), ("no", 0))}
    return {OURS: mine, RTKLIB: bar}


def measured(case: Case, intervals_s: tuple[int, ...], out: Path) -> Rows:
    """Return the rows of a case by interval, the base as recorded first."""
    rows: Rows = {}
    for interval_s in (0, *intervals_s):
        folder = out / case.name / str(interval_s)
        folder.mkdir(parents=True, exist_ok=True)
        thin = with_thin_base(case, interval_s, folder) if interval_s else case
        rows[str(interval_s or "-")] = measure(thin, folder)
    return rows


def cells(name: str, rows: Rows) -> Iterator[list[str]]:
    """Yield the rows of the table."""
    for interval, programs in rows.items():
        for program, ways in programs.items():
            for way, row in ways.items():
                yield [name, interval, program, way, *_figures(row)]


def _figures(row: Row) -> list[str]:
    if "failed" in row:
        return ["FAILED", row["failed"], "", "", ""]
    judged = "right_fix_pct" in row
    right = [f"{row['right_fix_pct']:.1f}", str(row["wrong_fixes"])] if judged else ["", ""]
    errors = [f"{1e3 * row[f'{axis}_fixed']['p95']:.1f}" for axis in ("h", "v")] if judged and row["h_fixed"] else ["", ""]
    return [f"{row['fix_pct']:.1f}", *right, *errors]


def main() -> int:
    options = _options()
    data = options.data or data_folder()
    if data is None or rtklib.missing():
        print("thin_base: needs the recordings (RTKMESH_DATA) and RTKLIB, which makes RINEX of them", file=sys.stderr)
        return 2
    try:
        cases = load(data, options.only.split(",") if options.only else list(QUICK if options.quick else RECORDINGS))
    except KeyError as error:
        print(f"thin_base: there is no case {error}", file=sys.stderr)
        return 2
    intervals_s = tuple(int(word) for word in options.intervals.split(","))
    rtklib.run([*_PROGRAM, "warm", "--json"])  # compiling is not what is measured
    report: dict[str, Rows] = {}
    with tempfile.TemporaryDirectory(prefix="rtkmesh_thin_base_") as folder:
        for case in cases:
            report[case.name] = measured(case, intervals_s, options.keep or Path(folder))
            print(f"{case.name} done", file=sys.stderr, flush=True)
    lines = [line for name, rows in report.items() for line in cells(name, rows)]
    print(json.dumps(report, indent=1) if options.json else table(COLUMNS, lines))
    return int(any("failed" in row for rows in report.values() for programs in rows.values() for row in programs[OURS].values()))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of the recordings")
    parser.add_argument("--only", help="names of cases, with commas between")
    parser.add_argument("--intervals", default=",".join(map(str, INTERVALS_S)), help="of base epochs, in seconds; divisors of 60")
    parser.add_argument("--quick", action="store_true", help="the short recordings only")
    parser.add_argument("--json", action="store_true", help="all figures, for programs")
    parser.add_argument("--keep", type=Path, help="folder for the files")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
