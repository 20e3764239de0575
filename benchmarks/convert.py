"""``rtkmesh convert`` and RTKLIB's convbin on every recording of receivers' bytes: observation by observation, and the time.

Usage: python benchmarks/convert.py [--data FOLDER] [--only PART_OF_NAME] [--details]   (default: RTKMESH_DATA or ../shared/data)

Both write RINEX 3; both results are read by our reader and compared. Times are processor time of whole processes (ours with its start,
about 0.6 s, and beside it the wall time of the conversion alone). Recordings are uncompressed before. Tables go to standard output.
"""

import argparse
import gzip
import json
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cases import data_folder
from conversion import Comparison, compare_navigation, compare_observations
from rtklib import ProgramError, missing, run
from rtkmesh_services.errors import SourceError
from rtkmesh_services.ingest.recording import RecordingKind, open_recording

FOLDERS = ("dec_ubx", "dec_rtcm3", "dec_gpsd", "galway_m8p", "sdq_f9p_2021", "stromlo_rtcm", "umea_f9p")
RAW = {RecordingKind.UBX: "ubx", RecordingKind.MIXED: "ubx", RecordingKind.RTCM3: "rtcm3"}
# RTCM 3 logs carry no date; those that are not named here are of 2018-07-11.
DATES = {
    "2016-04-06": ("rtcm3.2.log",),
    "2024-08-18": ("ntrip_",),
    "2018-07-14": ("STR17", "STR24"),
    "2018-07-17": ("piksi-5Hz",),
    "2018-07-16": ("piksi-2Hz",),
    "2021-08-09": ("20210809",),
}
HOURS = {"STR17": 23, "STR24": 23, "piksi-5Hz": 8, "20210809": 15, "rtcm3.2.log": 20}
COLUMNS = (
    "recording", "format", "epochs", "values alike", "only ours", "only convbin's", "differ", "slips alike / ours / convbin's",
    "half cycles alike / ours / convbin's", "ephemerides alike / ours / convbin's", "CPU s ours (converting)", "convbin",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Converted:
    """One recording through both programs."""

    observations: Comparison
    navigation: Comparison
    ours_cpu_s: float
    ours_converting_s: float
    theirs_cpu_s: float


def date_of(name: str) -> tuple[str, int]:
    """Return day and hour near which an RTCM 3 log begins."""
    day = next((day for day, parts in DATES.items() if any(part in name for part in parts)), "2018-07-11")
    return day, next((hour for part, hour in HOURS.items() if part in name), 12)


def convert(path: Path, kind: str, folder: Path) -> Converted:
    """Convert a recording by both programs; ProgramError when one fails, or when there is nothing to convert."""
    plain = path
    if path.suffix == ".gz":
        plain = folder / path.stem
        plain.write_bytes(gzip.decompress(path.read_bytes()))
    day, hour = date_of(path.name)
    command = [sys.executable, "-m", "rtkmesh_services.cli.main", "convert", str(plain), "--to", "rinex", "--out", str(folder / "ours")]
    ours = run([*command, "--json", *(["--date", day] if kind == "rtcm3" else [])])
    argv = ["convbin", "-r", kind, "-v", "3.04", "-od", "-os", "-tr", day.replace("-", "/"), f"{hour:02d}:00:00"]
    theirs = run([*argv, "-o", str(folder / "theirs.obs"), "-n", str(folder / "theirs.nav"), str(plain)])
    summary: dict[str, Any] = json.loads(ours.output)
    return Converted(
        compare_observations(folder / "ours.obs", folder / "theirs.obs"), compare_navigation(folder / "ours.nav", folder / "theirs.nav"),
        ours.cpu_s, summary["total_s"], theirs.cpu_s,
    )  # fmt: skip


def total(comparison: Comparison, start: str, end: str = "") -> int:
    """Return the sum of the counts whose names begin and end so."""
    return sum(count for kind, count in comparison.counts.items() if kind.startswith(start) and kind.endswith(end))


def line(name: str, kind: str, done: Converted) -> str:
    """Return a recording's line of the table."""
    seen, records = done.observations, done.navigation
    alike = sum(seen.counts[f"{name} alike"] for name in ("pseudorange_m", "phase_cyc", "doppler_hz", "cn0_dbhz"))
    flags = [
        f"{seen.counts[f'flag {flag} alike']} / {seen.counts[f'flag {flag} only ours']} / {seen.counts[f'flag {flag} only theirs']}"
        for flag in ("slip", "half cycle")
    ]
    epochs = f"{seen.counts['epochs']} (+{seen.counts['epochs only ours']} ours, +{seen.counts['epochs only theirs']} convbin's)"
    ephemerides = f"{records.counts['ephemerides']} / {total(records, 'only ours')} / {total(records, 'only theirs')}"
    cells = (
        name, kind, epochs, alike, total(seen, "only ours"), total(seen, "only theirs"), total(seen, "value"), *flags, ephemerides,
        f"{done.ours_cpu_s:.2f} ({done.ours_converting_s:.2f})", f"{done.theirs_cpu_s:.2f}",
    )  # fmt: skip
    return "| " + " | ".join(map(str, cells)) + " |"


def recordings(folder: Path, only: str) -> list[tuple[Path, str]]:
    """Return the logs of receivers' bytes with the name of their format."""
    found: list[tuple[Path, str]] = []
    named = {path.name: path for name in FOLDERS for path in sorted((folder / name).glob("*")) if path.is_file() and only in path.name}
    for path in named.values():  # some lie in two folders
        try:
            recording = open_recording(path)
        except SourceError:
            continue
        recording.close()
        if recording.kind in RAW:
            found.append((path, RAW[recording.kind]))
    return found


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=data_folder())
    parser.add_argument("--only", default="", help="part of the names of the recordings")
    parser.add_argument("--details", action="store_true", help="name every kind of difference, with examples")
    options = parser.parse_args()
    if options.data is None or missing():
        print("needs the recordings and RTKLIB's programs")
        return 1
    print("| " + " | ".join(COLUMNS) + " |\n|" + "---|" * len(COLUMNS))
    for path, kind in recordings(options.data, options.only):
        with tempfile.TemporaryDirectory() as folder:
            try:
                done = convert(path, kind, Path(folder))
            except ProgramError as error:
                if '"files": []' not in str(error):  # nothing to convert
                    print(f"| {path.name} | {kind} | {error} |")
                continue
        if not done.observations.counts["epochs"] and not done.navigation.counts["ephemerides"]:
            continue
        print(line(path.name, kind, done), flush=True)
        if options.details:
            for comparison in (done.observations, done.navigation):
                for kind_of, examples in sorted(comparison.examples.items()):
                    print(f"    {kind_of}: {comparison.counts[kind_of]}: {examples[:4]}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
