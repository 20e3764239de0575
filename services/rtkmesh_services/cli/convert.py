"""``rtkmesh convert``: recordings in, files of another format out. The engine is imported when the command runs, not for its help."""

import json
import sys
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from rtkmesh_services.cli.network import Json
from rtkmesh_services.cli.page import command_page
from rtkmesh_services.errors import SourceError

if TYPE_CHECKING:
    from rtkmesh.gnss.time import GpsTime
    from rtkmesh_services.cli.conversion import Conversion, Writer

_CONVERTED, _NOTHING = 0, 1
_COMPRESSIONS = (".gz", ".z", ".bz2", ".zip")
_ENDINGS = {"rinex": (".obs", ".nav"), "rinex4": (".obs", ".nav"), "rtcm3": (".rtcm3",), "json": (".json",), "csv": (".csv",)}
_DRAW_EVERY = 50  # epochs

_EXAMPLES = """
rtkmesh convert rover.ubx --to rinex
rtkmesh convert base.ubx.gz --to rinex4 --out roof --interval 30 --systems GE
rtkmesh convert base.obs base.nav --to rtcm3 --msm 4 --station-id 12
rtkmesh convert base.rtcm3 --date 2018-07-14 --to csv --start 2018-07-14T23:55:00
rtkmesh convert rover.ubx --to json --json --force
"""


@dataclass(frozen=True, kw_only=True)
class Request:
    """The options of ``rtkmesh convert``."""

    to: Annotated[
        Literal["rinex", "rinex4", "rtcm3", "json", "csv"],
        Parameter(help="RINEX 3.05 or 4.00 (NAME.obs and NAME.nav), RTCM 3, JSON (a line per message) or CSV (a line per observation)."),
    ]
    out: Annotated[
        Path | None,
        Parameter(help="The file, or for RINEX the name before .obs and .nav. Default: in this folder, named as the first input."),
    ] = None
    systems: Annotated[str, Parameter(help="Systems that are kept, as RINEX letters.")] = "GRECJSI"
    interval: Annotated[float, Parameter(help="Seconds: only epochs at whole multiples of it. 0: all.")] = 0.0
    start: Annotated[str | None, Parameter(help="First instant, YYYY-MM-DDTHH:MM:SS in GPS time.")] = None
    end: Annotated[str | None, Parameter(help="Last instant, likewise.")] = None
    date: Annotated[
        str | None, Parameter(help="Day on which RTCM 3 logs begin, YYYY-MM-DD: they carry no date. Not needed beside a dated recording.")
    ] = None
    receiver_options: Annotated[
        str, Parameter(allow_leading_hyphen=True, help="RTKLIB's receiver options for the logs (convbin's -ro): \"-TADJ=0.1 -GL2L\".")
    ] = ""
    msm: Annotated[Literal[4, 5, 7], Parameter(help="Type of RTCM 3 observation messages.")] = 7
    station_id: Annotated[int, Parameter(help="Station number of RTCM 3 messages, 0 to 4095.")] = 0
    marker: Annotated[str, Parameter(help="Name of the marker in RINEX files. Default: the name of the file.")] = ""
    force: Annotated[bool, Parameter(negative="", show_default=False, help="Replace files that are there.")] = False
    quiet: Annotated[bool, Parameter(negative="", show_default=False, help="No progress bar and no summary.")] = False


def convert(
    inputs: Annotated[list[Path], Parameter(help="Recordings, read one after the other as one stream; navigation files first.")],
    /,
    *,
    request: Annotated[Request, Parameter(name="*")],
    as_json: Json = False,
) -> int:
    """Convert recordings to RINEX, RTCM 3, JSON or CSV.

    Recordings are RINEX 2 to 4 (also Hatanaka), logs of receivers' bytes, also of mixed protocols, plain or compressed; the kind is found
    from the content. Files that are there are not replaced without --force, and a file appears only when it is whole.

    Exit codes: 0 converted, 1 there was nothing to convert, 2 wrong usage or a file that cannot be read.
    """
    from rtkmesh_services.cli.conversion import Conversion, Selection
    from rtkmesh_services.cli.recordings import day_of, open_recordings
    from rtkmesh_services.cli.written_files import check_free

    _check(request)
    paths = _outputs(request, inputs[0])
    check_free(paths, inputs, force=request.force)
    start, end = (_instant(flag, text) if text else None for flag, text in (("--start", request.start), ("--end", request.end)))
    with ExitStack() as stack:
        recordings = open_recordings(inputs, day_of(request.date) if request.date else None, request.receiver_options)
        for recording in recordings:
            stack.callback(recording.close)
        conversion = Conversion(recordings, Selection(request.systems, request.interval, start, end), _writer(request, paths, inputs))
        _run(conversion, shown=not request.quiet and sys.stderr.isatty())
    if as_json:
        sys.stdout.write(json.dumps({**conversion.tally.as_dict(), "rejected": conversion.faults()}, indent=1) + "\n")
    elif not request.quiet:
        _report(conversion)
    return _CONVERTED if conversion.tally.files else _NOTHING


def _check(request: Request) -> None:
    if not request.systems or set(request.systems) - set("GRECJSI"):
        raise SourceError(f"--systems {request.systems}: allowed are the letters GRECJSI")
    if not 0.0 <= request.interval <= 86400.0:
        raise SourceError(f"--interval {request.interval}: allowed are 0 to 86400 seconds")
    if not 0 <= request.station_id <= 4095:
        raise SourceError(f"--station-id {request.station_id}: allowed are 0 to 4095")


def _outputs(request: Request, first: Path) -> list[Path]:
    """Return the files that may be written."""
    endings = _ENDINGS[request.to]
    if request.out is None:
        stem = first.stem if first.suffix.lower() in _COMPRESSIONS else first.name
        base = Path(Path(stem).stem)
        return [base.with_name(base.name + ending) for ending in endings]
    if len(endings) == 1:
        return [request.out]
    base = request.out.with_suffix("") if request.out.suffix in endings else request.out
    return [base.with_name(base.name + ending) for ending in endings]


def _instant(flag: str, text: str) -> "GpsTime":
    """Return the GPS instant of a calendar text; SourceError if it is none."""
    from datetime import datetime

    from rtkmesh.gnss.time import GpsTime

    try:
        date = datetime.fromisoformat(text)
    except ValueError:
        date = None
    if date is None or date.tzinfo is not None:
        raise SourceError(f"{flag} {text} is no instant YYYY-MM-DDTHH:MM:SS (GPS time, so without a time zone)")
    return GpsTime.from_calendar(date.year, date.month, date.day, date.hour, date.minute, date.second + date.microsecond * 1e-6)


def _writer(request: Request, paths: list[Path], inputs: list[Path]) -> "Writer":
    from rtkmesh.codecs.rtcm3_base import BaseOptions
    from rtkmesh_services.cli.conversion_writers import RinexWriter, csv_writer, json_writer, rtcm3_writer

    if request.to in ("rinex", "rinex4"):
        comments = tuple(f"from {path.name}" for path in inputs)
        return RinexWriter(paths[0], paths[1], 4.0 if request.to == "rinex4" else 3.05, request.marker or paths[0].stem, comments)
    if request.to == "rtcm3":
        return rtcm3_writer(paths[0], BaseOptions(msm=request.msm, station_id=request.station_id))
    return json_writer(paths[0]) if request.to == "json" else csv_writer(paths[0])


def _run(conversion: "Conversion", *, shown: bool) -> None:
    """Convert with a bar on standard error."""
    if not shown:
        conversion.run(lambda _: None)
        return
    from rtkmesh_services.cli.progress import bar

    with bar() as progress:
        task, countdown = progress.add_task("converting", total=1.0), [0]

        def watch(part: float) -> None:
            countdown[0] -= 1
            if countdown[0] < 0:
                countdown[0] = _DRAW_EVERY
                progress.update(task, completed=part, description=f"{conversion.tally.counts['epochs']} epochs")

        conversion.run(watch)


def _report(conversion: "Conversion") -> None:
    from rich.console import Console
    from rich.table import Table

    tally = conversion.tally
    table = Table(show_header=False, box=None, pad_edge=False)
    for kind, count in tally.counts.items():
        table.add_row(kind, str(count))
    for path, size in tally.files:
        table.add_row("written", f"{path} ({size:,} bytes)".replace(",", " "))
    if not tally.files:
        table.add_row("written", "nothing: neither observations nor ephemerides of what was wanted")
    table.add_row("time", f"{tally.total_s:.2f} s")
    for name, counts in conversion.faults().items():
        for reason, count in sorted(counts.items(), key=lambda item: -item[1])[:3]:
            table.add_row("rejected", f"{name}: {reason} ({count})")
    Console(stderr=True).print(table)


app = command_page(convert, _EXAMPLES)
