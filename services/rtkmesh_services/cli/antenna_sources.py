"""Where a calibration's positions and baselines come from: .pos files, recordings that are solved as a moving base, a running network."""

import sys
import time
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.attitude.calibration import Instant
from rtkmesh.attitude.joint import Edge, joint, made_positive
from rtkmesh.attitude.rigid_body import Layout
from rtkmesh.attitude.rotation import NED_FROM_ENU
from rtkmesh.codecs.pos_read import Coordinates, PosRow, read_pos
from rtkmesh.gnss.frames import enu_from_ecef_at
from rtkmesh_schemas.errors import SchemaError
from rtkmesh_schemas.keys import SOL
from rtkmesh_schemas.solution import SolutionMessage
from rtkmesh_schemas.wire import decode
from rtkmesh_services.errors import SourceError

Vector = NDArray[np.float64]

FIX: Final = 1
_SAME_S: Final = 0.05  # epochs of antennas less than half of this apart are the same
_WEEK_S: Final = 604800.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Named:
    """``NAME=WHAT``: positions of an antenna; ``FROM-TO=WHAT``: baselines between two."""

    start: str | None
    end: str
    what: str


@dataclass(slots=True)
class Series:
    """The solutions of one antenna, or of one baseline; ``vector_m`` of its rows is ECEF or east-north-up."""

    named: Named
    rows: list[PosRow] = field(default_factory=list[PosRow])
    skipped: int = 0
    not_fixed: int = 0


def named(text: str, flag: str = "") -> Named:
    """Return the parts of ``NAME=WHAT`` or ``FROM-TO=WHAT``; SourceError if it is neither."""
    name, _, what = text.partition("=")
    start, dash, end = name.partition("-")
    if not name or not what or (dash and not (start and end)) or start == end:
        given = f"{flag} {text}".lstrip()
        raise SourceError(f"{given}: say NAME=... for positions of an antenna, or FROM-TO=... for baselines between two")
    return Named(start=start if dash else None, end=end if dash else name, what=what)


def from_pos(source: Named, *, floats: bool) -> Series:
    """Return the solutions of a .pos file; SourceError where it has none of the kind that its name says."""
    try:
        with Path(source.what).open(encoding="ascii", errors="replace") as lines:
            found = read_pos(lines)
    except OSError as error:
        raise SourceError(f"{source.what}: {error.strerror}") from error
    if not found.rows:
        raise SourceError(f"{source.what}: no solutions (a .pos file of RTKLIB's format is needed)")
    baseline = found.kind is Coordinates.ENU
    if baseline != (source.start is not None):
        wanted = "FROM-TO=FILE (it holds baselines)" if baseline else "NAME=FILE (it holds positions)"
        raise SourceError(f"{source.what}: say {wanted}")
    return _fixed(source, found.rows, found.skipped, floats=floats)


def _fixed(source: Named, rows: list[PosRow], skipped: int, *, floats: bool) -> Series:
    good = [row for row in rows if row.status == FIX or (floats and row.status == FIX + 1)]
    return Series(source, good, skipped, len(rows) - len(good))


@dataclass(frozen=True, slots=True, kw_only=True)
class Solving:
    """How recordings are solved."""

    nav: tuple[Path, ...] = ()
    date: str = ""
    frequencies: int = 2
    floats: bool = False
    shown: bool = False


def from_recordings(receivers: list[Named], solving: Solving) -> list[Series]:
    """Return the baselines from the first receiver's antenna to each other one, solved as moving bases."""
    if len(receivers) < 2 or any(receiver.start is not None for receiver in receivers):
        raise SourceError("recordings of two antennas or more are needed: --rover NAME=FILE --rover NAME=FILE ...")
    first = receivers[0]
    return [_solved(first, other, solving) for other in receivers[1:]]


def _solved(first: Named, other: Named, solving: Solving) -> Series:
    from rtkmesh_schemas.config import SolverTable
    from rtkmesh_services.cli.offline import Run, open_inputs
    from rtkmesh_services.cli.recordings import day_of
    from rtkmesh_services.cli.solve_display import ProgressBar
    from rtkmesh_services.mapping.options import session_options

    navigation = tuple(f"nav{k}" for k in range(len(solving.nav)))
    table = SolverTable(rover="rover", base="base", navigation=navigation, mode="moving-base", frequencies=solving.frequencies)
    date = day_of(solving.date) if solving.date else None
    run = Run(open_inputs(Path(other.what), Path(first.what), solving.nav, date), session_options(table, replay=True))
    with ProgressBar(run, shown=solving.shown):
        rows = [_row_of(solution) for solution in run.solutions()]
    return _fixed(Named(start=first.end, end=other.end, what=other.what), [r for r in rows if r is not None], 0, floats=solving.floats)


def _row_of(solution: Any) -> PosRow | None:
    """Return the baseline of a solution of the engine, None if it has none."""
    if not np.isfinite(solution.baseline_ecef_m).all():
        return None
    turn = enu_from_ecef_at(solution.base_ecef_m)
    return PosRow(solution.time, int(solution.status), turn @ solution.baseline_ecef_m, turn @ solution.baseline_cov_ecef_m2 @ turn.T)


def from_network(bus: Any, sources: list[Named], seconds: float, *, floats: bool) -> list[Series]:
    """Return what solvers publish within some seconds; ``bus`` is connected. SourceError where one says nothing."""
    from rtkmesh.gnss.time import GpsTime
    from rtkmesh_services.runtime.inbox import Inbox

    inbox, by_key = Inbox(capacity=100_000), {SOL.key(source.what): source for source in sources}
    found: dict[Named, list[PosRow]] = {source: [] for source in sources}
    for key in by_key:
        bus.subscribe(key, inbox.put)
    end_s = time.monotonic() + seconds
    while (left_s := end_s - time.monotonic()) > 0.0:
        sample = inbox.get(min(left_s, 0.5))
        if sample is None:
            continue
        source = next(s for key, s in by_key.items() if sample.key.endswith(key))
        try:
            message = decode(SolutionMessage, sample.payload, sample.encoding)
        except SchemaError:
            continue
        row = _row_of_message(message, GpsTime(message.week, message.tow_s), baseline=source.start is not None)
        if row is not None:
            found[source].append(row)
    silent = [source.what for source, rows in found.items() if not rows]
    if silent:
        raise SourceError(f"no solutions within {seconds:g} s from {', '.join(silent)}: is it a solver, and does it solve?")
    return [_fixed(source, rows, 0, floats=floats) for source, rows in found.items()]


def _row_of_message(message: SolutionMessage, at: Any, *, baseline: bool) -> PosRow | None:
    vector, cov = (
        (message.baseline_enu_m, message.baseline_cov_enu_m2) if baseline else (message.position_ecef_m, message.position_cov_enu_m2)
    )
    values, matrix = np.array(vector), np.array(cov).reshape(3, 3)
    return PosRow(at, message.status, values, matrix) if np.isfinite(values).all() and np.isfinite(matrix).all() else None


def names_of(series: list[Series]) -> tuple[str, ...]:
    """Return the antennas in the order in which they are named."""
    return tuple(dict.fromkeys(name for one in series for name in (one.named.start, one.named.end) if name is not None))


def instants_of(series: list[Series], names: tuple[str, ...]) -> list[Instant]:
    """Return what was measured, epoch by epoch: epochs of the same time are one instant. All in NED at the first position.

    What positions share is their base's: it moves the body as a whole, so it is not told apart and each has a base of its own here.
    """
    positions = [one.rows[0].vector_m for one in series if one.named.start is None and one.rows]
    origin = positions[0] if positions else None
    found: dict[int, list[Edge]] = defaultdict(list)
    for one in series:
        for row in one.rows:
            found[_epoch(row)].append(_edge(one.named, row, origin))
    layout = Layout(names, np.zeros((len(names), 3)))  # its places are what is sought
    return [Instant(epoch * _SAME_S, joint(layout, edges)) for epoch, edges in sorted(found.items())]


def _edge(named: Named, row: PosRow, origin: Vector | None) -> Edge:
    cov = made_positive(NED_FROM_ENU @ row.cov_enu_m2 @ NED_FROM_ENU)
    return Edge(f"{named.end}: base" if named.start is None else named.start, named.end, _ned(row, named.start, origin), cov)


def _epoch(row: PosRow) -> int:
    return round((row.time.week * _WEEK_S + row.time.tow_s) / _SAME_S)


def _ned(row: PosRow, start: str | None, origin: Vector | None) -> Vector:
    if start is not None or origin is None:
        return NED_FROM_ENU @ row.vector_m
    return NED_FROM_ENU @ enu_from_ecef_at(origin) @ (row.vector_m - origin)


def warn(series: list[Series]) -> None:
    """Say on standard error what was left out."""
    for one in series:
        parts = [f"{count} {what}" for count, what in ((one.not_fixed, "not fixed"), (one.skipped, "lines unreadable")) if count]
        if parts:
            sys.stderr.write(f"rtkmesh antennas: {one.named.what}: left out: {', '.join(parts)}\n")


def three(flag: str, text: str) -> tuple[float, float, float]:
    """Return three numbers; SourceError if they are not."""
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != 3 or not all(np.isfinite(numbers)):
        raise SourceError(f"{flag} {text}: three numbers with commas between are needed")
    return numbers
