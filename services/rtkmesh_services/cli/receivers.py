"""What the sources of receivers bring: one line each for ``rtkmesh top``, the whole of it for ``rtkmesh status ID``."""

import math
from collections.abc import Mapping
from typing import Final

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from rtkmesh_schemas.status import InputStatus, ReferenceStatus, ServiceStatus, StreamStatus
from rtkmesh_services.cli.columns import WIDE, Column, cells, fitted_table
from rtkmesh_services.runtime.logs import clean

_SOURCE_COLOURS: Final = {"connected": "green", "error": "red", "connecting": "yellow", "waiting for data": "yellow"}
_WEAK_DBHZ, _GOOD_DBHZ = 30.0, 40.0
_OLD_S: Final = 5.0
_RECEIVERS: Final = (
    Column("receiver"),
    Column("source", 4),
    Column("state"),
    Column("kB/s", 3, right=True, least=6),
    Column("epochs/s", 1, right=True),
    Column("satellites", 2, least=20),
    Column("C/N0 mean, min", 5, right=True, least=11),
    Column("CRC", 6, right=True, least=4),
    Column("refused", 7, right=True, least=4),
    Column("antenna from", 8),
)


def receiver_table(statuses: Mapping[str, tuple[ServiceStatus, int]], now_ns: int, width: int = WIDE) -> Table | None:
    """Return a line for each source of each ingest, None where there is no ingest."""
    rows = [
        _receiver_cells(id_, source, (now_ns - heard_ns) * 1e-9)
        for id_, (status, heard_ns) in sorted(statuses.items())
        for source in status.inputs
        if source.stream is not None
    ]
    return fitted_table(list(_RECEIVERS), rows, width) if rows else None


def _receiver_cells(id_: str, source: InputStatus, silent_s: float) -> list[Text]:
    stream = source.stream or StreamStatus()
    age_s = math.inf if stream.epoch_age_s is None else stream.epoch_age_s + silent_s
    old = stream.epoch_age_s is not None and age_s > _OLD_S
    return cells(
        id_,
        clean(source.name),
        state_of(source),
        f"{stream.bytes_per_s * 1e-3:.1f}",
        Text(f"{age_s:.0f} s ago", style="yellow") if old else f"{stream.epochs_per_s:.1f}",
        satellites_words(stream),
        _strength(stream),
        _count(sum(stream.checksum_failures.values())),
        _count(sum(stream.refused.values())),
        "-" if stream.reference is None else clean(stream.reference.origin),
    )


def source_words(source: InputStatus) -> str:
    """Return a source in a few words."""
    stream = source.stream
    if stream is None or not stream.epochs:
        return f"{source.name} {source.state}"
    return f"{source.name} {source.state}, {stream.epochs_per_s:.1f} epochs/s, {sum(stream.satellites.values())} satellites"


def source_details(status: ServiceStatus) -> RenderableType:
    """Return all that a process tells of its sources."""
    return Group(*(part for source in status.inputs for part in _details(source)))


def _details(source: InputStatus) -> list[RenderableType]:
    lines = Table(box=None, show_header=False, pad_edge=False)
    lines.add_column(style="dim")
    lines.add_column(overflow="fold")
    stream = source.stream
    lines.add_row("source", Text.assemble((clean(source.name), "bold"), " ", state_of(source), f"  {clean(source.detail)}"))
    age = "nothing came yet" if source.age_s is None else f"newest {source.age_s:.1f} s ago"
    if stream is None:
        lines.add_row("messages", f"{source.messages}, {age}")
        return [lines]
    lines.add_row("bytes", f"{source.bytes} ({stream.bytes_per_s * 1e-3:.1f} kB/s), {age}, {stream.bytes_skipped} of no frame")
    if stream.epoch_age_s is not None:
        lines.add_row("epochs", f"{stream.epochs} ({stream.epochs_per_s:.2f}/s), newest {stream.epoch_age_s:.1f} s ago")
        lines.add_row("satellites", satellites_words(stream))
        lines.add_row("signals", " ".join(map(clean, stream.signals)))
        lines.add_row("C/N0", _strengths(stream))
    if stream.reference is not None:
        lines.add_row("antenna", reference_words(stream.reference))
    lines.add_row("errors", _refusals(source, stream))
    return [lines, _frames(stream), Text("")] if stream.frames else [lines, Text("")]


def _frames(stream: StreamStatus) -> Table:
    table = Table(box=None, pad_edge=False, header_style="dim")
    for name in ("frames", "count", "per s", "age s"):
        table.add_column(name, justify="left" if name == "frames" else "right")
    for kind, row in stream.frames.items():
        style = "yellow" if row.per_s == 0.0 and row.age_s > _OLD_S else ""
        table.add_row(clean(kind), str(row.count), f"{row.per_s:.2f}", Text(f"{row.age_s:.1f}", style=style))
    return table


def _refusals(source: InputStatus, stream: StreamStatus) -> Text:
    found = [f"{count} checksums of {name}" for name, count in stream.checksum_failures.items()]
    found += [f"{count} {name}" for name, count in sorted(stream.refused.items(), key=lambda item: -item[1])]
    return Text(clean(", ".join(found)), style="yellow") if found else Text("none" if source.messages else "-", style="dim")


def state_of(source: InputStatus) -> Text:
    """Return a source's state in its colour."""
    return Text(clean(source.state), style=_SOURCE_COLOURS.get(source.state, ""))


def satellites_words(stream: StreamStatus) -> str:
    """Return the satellites as ``23: G9 R6 E8``."""
    systems = " ".join(f"{clean(system)}{count}" for system, count in stream.satellites.items())
    return f"{sum(stream.satellites.values())}: {systems}" if systems else "-"


def reference_words(reference: ReferenceStatus) -> str:
    """Return where the antenna stands and who says so."""
    position = " ".join(f"{value:.4f}" for value in reference.position_ecef_m)
    said = "" if reference.age_s is None else f", said {reference.age_s:.1f} s ago"
    return f"ECEF {position} m, from {clean(reference.origin)}{said}"


def _strength(stream: StreamStatus) -> Text:
    bands = stream.cn0_dbhz.values()
    signals = sum(band.count for band in bands)
    if not signals:
        return Text("-")
    mean = sum(band.mean * band.count for band in bands) / signals
    return Text(f"{mean:.1f} {min(band.minimum for band in bands):.0f}", style=_grade(mean))


def _strengths(stream: StreamStatus) -> Text:
    parts = [
        (f"band {band}: {row.mean:.1f} (min {row.minimum:.0f}, {row.count})  ", _grade(row.mean)) for band, row in stream.cn0_dbhz.items()
    ]
    return Text.assemble(*parts, "dB-Hz") if parts else Text("-")


def _grade(cn0_dbhz: float) -> str:
    return "green" if cn0_dbhz >= _GOOD_DBHZ else "yellow" if cn0_dbhz >= _WEAK_DBHZ else "red"


def _count(number: int) -> Text:
    return Text(str(number), style="yellow" if number else "dim")
