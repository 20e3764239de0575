"""A solver's messages in, texts out: which epochs are written, and with which satellites."""

from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import fields
from math import sqrt
from typing import Any, Final, Protocol

import msgspec

from rtkmesh.gnss.decimation import Decimator
from rtkmesh.gnss.time import GpsTime
from rtkmesh_schemas.config import OutputTable, SolverTable
from rtkmesh_schemas.solution import SatellitesMessage, SolutionMessage
from rtkmesh_schemas.wire import encode_json
from rtkmesh_services.texts import TextAbout, TextOptions, TextWriter

HOLD_NS: Final = 100_000_000  # how long an epoch waits for its satellites
OUT_OF_STEP: Final = 3  # epochs without satellites after which sentences wait for them no more
SINGLE: Final = 5  # RTKLIB's Q
PROGRAM: Final = "rtkmesh"
_NAMES: Final = {
    "interval_s": "nmea_interval_s",
    "satellites_interval_s": "nmea_satellites_interval_s",
    "nmea": "nmea_rule",
    "status": "status_level",
}
_BANDS: Final = ("L1", "L2", "L5", "L6", "L7")
_SYSTEMS: Final = {"G": "gps", "R": "glonass", "E": "galileo", "J": "qzss", "C": "beidou", "S": "sbas", "I": "navic"}


class Writer(Protocol):
    """Writes the messages of one solver."""

    def header(self, about: TextAbout) -> bytes:
        """Return what stands before the first solution."""
        ...

    def epoch(self, solution: SolutionMessage, satellites: SatellitesMessage | None = None) -> bytes:
        """Return the text of an epoch, nothing where there is none."""
        ...

    def mark(self, data: Mapping[str, Any]) -> bytes:
        """Return the text of a mark."""
        ...


class JsonWriter:
    """A line of JSON for each solution: the whole message."""

    def header(self, about: TextAbout) -> bytes:
        """Return nothing: every line explains itself."""
        del about
        return b""

    def epoch(self, solution: SolutionMessage, satellites: SatellitesMessage | None = None) -> bytes:
        """Return the message as JSON."""
        del satellites
        return encode_json(solution) + b"\n"

    def mark(self, data: Mapping[str, Any]) -> bytes:
        """Return the mark as JSON."""
        return msgspec.json.encode({"mark": data}) + b"\n"


class TextFeed:
    """Decides what is written of one solver, in the order of its epochs."""

    def __init__(self, table: OutputTable, solver: SolverTable) -> None:
        self._table, self._writer = table, writer_of(table)
        self._decimator = Decimator(table.interval_s)
        self._held: deque[tuple[int, SolutionMessage]] = deque()  # since when, and what waits for its satellites
        self._satellites: deque[SatellitesMessage] = deque(maxlen=8)
        self._gap = self._since = 0  # solutions between the last two satellites, and after them
        self.header = self._writer.header(about(solver))

    def solution(self, solution: SolutionMessage, now_ns: int) -> Iterator[bytes]:
        """Yield the texts that are ready after a solution has come."""
        self._since += 1
        if self._is_wanted(solution):
            self._held.append((now_ns, self._shown(solution)))
        yield from self._ready(now_ns)

    def satellites(self, satellites: SatellitesMessage, now_ns: int) -> Iterator[bytes]:
        """Yield the texts that are ready after satellites have come."""
        self._satellites.append(satellites)
        self._gap, self._since = self._since, 0
        yield from self._ready(now_ns)

    def overdue(self, now_ns: int) -> Iterator[bytes]:
        """Yield the texts that have waited long enough."""
        yield from self._ready(now_ns)

    def due_ns(self) -> float:
        """Return when the oldest has waited long enough."""
        return self._held[0][0] + HOLD_NS if self._held else float("inf")

    def rest(self) -> Iterator[bytes]:
        """Yield what still waits: nothing more comes."""
        yield from self._ready(1 << 62)

    def mark(self, data: Mapping[str, Any]) -> bytes:
        """Return the text of a mark."""
        return self._writer.mark(data)

    def _ready(self, now_ns: int) -> Iterator[bytes]:
        while self._held:
            since_ns, solution = self._held[0]
            seen = any((one.week, one.tow_s) >= (solution.week, solution.tow_s) for one in self._satellites)
            if not seen and now_ns - since_ns < HOLD_NS and self._is_worth_waiting():
                return
            self._held.popleft()
            if text := self._writer.epoch(solution, self._satellites_of(solution)):
                yield text

    def _satellites_of(self, solution: SolutionMessage) -> SatellitesMessage | None:
        """Return the satellites of an epoch; for sentences the newest where there are none."""
        own = next((one for one in self._satellites if (one.week, one.tow_s) == (solution.week, solution.tow_s)), None)
        if own is not None or self._table.format == "stat" or not self._satellites:
            return own
        return self._satellites[-1]

    def _is_worth_waiting(self) -> bool:
        """Whether satellites come with every epoch; a solver that began before this output was there sends them once a second.

        Records are only of their own epoch, sentences take the newest satellites, and come at once.
        """
        in_step = max(self._gap, self._since) <= OUT_OF_STEP
        return self._table.takes_satellites and (in_step or self._table.format == "stat")

    def _is_wanted(self, solution: SolutionMessage) -> bool:
        limit_m = self._table.max_sigma_m
        if limit_m > 0.0 and sqrt(max(0.0, *solution.position_cov_ecef_m2[::4])) > limit_m:
            return False
        return self._decimator.takes(GpsTime(solution.week, solution.tow_s))

    def _shown(self, solution: SolutionMessage) -> SolutionMessage:
        """Return the solution as RTKRCV has it: without ``single``, one without the base counts as none where there is a base."""
        if self._table.format == "json" or self._table.single or solution.mode == "single" or solution.status != SINGLE:
            return solution
        return msgspec.structs.replace(solution, status=0, status_name="NONE")


def writer_of(table: OutputTable) -> Writer:
    """Return what writes a table's format."""
    return JsonWriter() if table.format == "json" else TextWriter(text_options(table))


def text_options(table: OutputTable) -> TextOptions:
    """Return how a table wants its texts; its keys have the names of the options but for a few."""
    return TextOptions(**{field.name: getattr(table, _NAMES.get(field.name, field.name)) for field in fields(TextOptions)})


def about(solver: SolverTable) -> TextAbout:
    """Return what headers tell of a solver, in RTKLIB's words."""
    options = [
        ("pos mode", solver.mode),
        ("freqs", "+".join(_BANDS[: solver.frequencies])),
        ("elev mask", f"{solver.elevation_mask_deg:.1f} deg"),
        ("ephemeris", "broadcast"),
        ("navi sys", " ".join(_SYSTEMS[letter] for letter in solver.systems)),
        ("amb res", solver.ambiguity.mode or "continuous"),
    ]
    return TextAbout(PROGRAM, options=options)
