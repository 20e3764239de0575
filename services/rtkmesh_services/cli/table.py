"""The live table of a network: positions, headings, processes. One colour and one word per state, everywhere."""

import math
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from rtkmesh_schemas.attitude import AttitudeMessage
from rtkmesh_schemas.solution import SolutionMessage
from rtkmesh_schemas.status import ServiceStatus, State
from rtkmesh_services.cli.board import Board, Track
from rtkmesh_services.cli.columns import FREE_TEXT, WIDE, Column, cells, coloured, fitted_table, number
from rtkmesh_services.cli.receivers import receiver_table, source_words

REFRESH_HZ: Final = 4.0
SILENT_S: Final = 3.0
_DIAGONAL: Final = (0, 4, 8)  # of a row-major 3x3


_SOLUTIONS: Final = (
    Column("solver"),
    Column("state"),
    Column("position / baseline", 1, least=32),
    Column("sigma H, V m", 4, right=True),
    Column("integrity", 8, least=11),
    Column("limit H, V m", 9, right=True, least=13),
    Column("age s", 6, right=True),
    Column("ratio", 7, right=True, least=6),
    Column("sats", 5, right=True, least=5),
    Column("latency ms", 3, right=True, least=13),
)
_ATTITUDES: Final = (
    Column("attitude"),
    Column("state"),
    Column("integrity", 4),
    Column("heading deg", 1, right=True, least=13),
    Column("pitch deg", 3, right=True, least=13),
    Column("length error m", 6, right=True),
    Column("latency ms", 5, right=True, least=13),
)
_PROCESSES: Final = (
    Column("process"),
    Column("role", 3),
    Column("process is"),
    Column("service is", 1),
    Column("pid", 6, right=True),
    Column("restarts", 4, right=True),
    Column("up s", 5, right=True),
    Column(FREE_TEXT, 2),
)


@dataclass(frozen=True, slots=True)
class Truth:
    """What the demo knows: the error of a solution (east, north, up in metres) and of a heading (degrees); None: not known."""

    position: Callable[[str, SolutionMessage], tuple[float, float, float] | None]
    heading: Callable[[str, AttitudeMessage], float | None]


@dataclass(slots=True)
class View:
    """What is shown. ``processes`` gives control's rows when control is at hand, else they come from the network."""

    board: Board
    title: str = "rtkmesh"
    truth: Truth | None = None
    processes: Callable[[], list[dict[str, Any]]] | None = None
    note: Callable[[], str] | None = None
    started_s: float = field(default_factory=time.monotonic)
    width: int = WIDE

    def render(self) -> RenderableType:
        """Return the whole picture of this moment."""
        now_ns = time.monotonic_ns()
        parts: list[RenderableType] = [self._headline()]
        if self.board.solutions:
            parts.append(solution_table(self.board.solutions, now_ns, self.truth, self.width))
        if self.board.attitudes:
            parts.append(attitude_table(self.board.attitudes, now_ns, self.truth, self.width))
        if receivers := receiver_table(self.board.statuses, now_ns, self.width):
            parts.append(receivers)
        rows = self.processes() if self.processes is not None else None
        parts.append(process_table(rows if rows is not None else supervised(self.board), self.board.statuses, now_ns, self.width))
        return Group(*parts)

    def _headline(self) -> Text:
        seconds = int(time.monotonic() - self.started_s)
        text = Text(f"{self.title}  {seconds // 60:d}:{seconds % 60:02d}", style="bold")
        if self.note is not None:
            text.append(f"  {self.note()}", style="not bold")
        if self.board.lost:
            text.append(f"  {self.board.lost} messages not shown", style="not bold yellow")
        return text


class Display:
    """Shows a view on a terminal a few times per second. What is logged meanwhile goes above it."""

    def __init__(self, view: View, console: Console | None = None) -> None:
        self._console = console or Console()
        self._live = Live(view.render(), console=self._console, auto_refresh=False, transient=False, redirect_stderr=True)
        self._view = view
        self._next_s = 0.0

    def start(self) -> None:
        """Take the terminal."""
        self._live.start()

    def refresh(self, now_s: float) -> None:
        """Draw if it is time."""
        if now_s >= self._next_s:
            self._next_s = now_s + 1.0 / REFRESH_HZ
            self._view.width = self._console.width
            self._live.update(self._view.render(), refresh=True)

    def stop(self) -> None:
        """Draw a last time and give the terminal back."""
        self._live.update(self._view.render(), refresh=True)
        self._live.stop()


def solution_table(tracks: Mapping[str, Track[SolutionMessage]], now_ns: int, truth: Truth | None = None, width: int = WIDE) -> Table:
    """Return the table of the solvers: moving baselines show the baseline, all others the position."""
    rows: list[list[Text]] = []
    for id_, track in sorted(tracks.items()):
        message = track.newest
        row = cells(
            id_,
            _state(message.status_name, track, now_ns),
            _place(message),
            _pair(*_sigma(message)),
            coloured(message.integrity),
            _pair(message.protection_horizontal_m, message.protection_vertical_m),
            number(message.age_s, 1),
            number(message.ratio, 1),
            f"{message.satellites_used}/{message.satellites_rover}",
            _latency(track, now_ns),
        )
        if truth:
            error = truth.position(id_, message)
            row += cells("-" if error is None else " ".join(f"{part:+.3f}" for part in error))
        rows.append(row)
    return fitted_table([*_SOLUTIONS, *([Column("error E, N, U m", 2, right=True, least=20)] if truth else [])], rows, width)


def attitude_table(tracks: Mapping[str, Track[AttitudeMessage]], now_ns: int, truth: Truth | None = None, width: int = WIDE) -> Table:
    """Return the table of the headings."""
    rows: list[list[Text]] = []
    for id_, track in sorted(tracks.items()):
        message = track.newest
        sigmas = [math.degrees(math.sqrt(message.covariance_rad2[i])) if message.covariance_rad2[i] >= 0.0 else math.nan for i in _DIAGONAL]
        row = cells(
            id_,
            _state(message.status_name, track, now_ns),
            coloured(message.integrity),
            f"{number(math.degrees(message.heading_rad), 2)} ± {number(sigmas[0], 2)}",
            f"{number(math.degrees(message.pitch_rad), 2)} ± {number(sigmas[1], 2)}",
            number(message.length_error_m, 3),
            _latency(track, now_ns),
        )
        if truth:
            error = truth.heading(id_, message)
            row += cells("-" if error is None else f"{error:+.2f}")
        rows.append(row)
    return fitted_table([*_ATTITUDES, *([Column("error deg", 2, right=True)] if truth else [])], rows, width)


def process_table(
    rows: Iterable[Mapping[str, Any]], statuses: Mapping[str, tuple[ServiceStatus, int]], now_ns: int, width: int = WIDE
) -> Table:
    """Return the table of the processes: what control knows of them and what they say themselves."""
    return fitted_table(list(_PROCESSES), [_process_cells(row, statuses.get(row["id"]), now_ns) for row in rows], width)


def _process_cells(row: Mapping[str, Any], heard: tuple[ServiceStatus, int] | None, now_ns: int) -> list[Text]:
    says, word = row.get("reason", ""), Text("-", style="dim")
    if heard is not None and heard[0].pid == row["pid"]:
        status, age_s = heard[0], (now_ns - heard[1]) * 1e-9
        word = coloured(str(status.state)) if age_s <= SILENT_S else Text(f"silent {age_s:.0f} s", style="yellow")
        says = says or status.reason or _inputs(status)
    up_s, pid = f"{row['uptime_s']:.0f}", str(row["pid"] or "-")
    return cells(row["id"], row["role"], coloured(row["state"]), word, pid, str(row["restarts"]), up_s, says)


def supervised(board: Board) -> list[dict[str, Any]]:
    """Return the rows of all processes as the network tells them: control's table, and the others by their own status."""
    rows: list[dict[str, Any]] = []
    for status, _ in board.statuses.values():
        found: Any = status.data.get("processes")
        if status.role == "control" and isinstance(found, list):
            rows += found
    known = {row["id"] for row in rows}
    for id_, (status, _) in sorted(board.statuses.items()):
        if id_ not in known:
            word = "RUNNING" if status.state not in (State.STOPPED, State.FAILED) else str(status.state)
            rows.append(
                {"id": id_, "role": status.role, "state": word, "pid": status.pid, "restarts": 0, "uptime_s": status.uptime_s, "reason": ""}
            )
    return rows


def horizontal_sigma(cov_enu_m2: tuple[float, ...]) -> tuple[float, float]:
    """Return (horizontal, vertical) standard deviation of a row-major ENU covariance, metres; NaN if unknown."""
    horizontal, vertical = cov_enu_m2[0] + cov_enu_m2[4], cov_enu_m2[8]
    return (math.sqrt(horizontal) if horizontal >= 0.0 else math.nan, math.sqrt(vertical) if vertical >= 0.0 else math.nan)


def _sigma(message: SolutionMessage) -> tuple[float, float]:
    return horizontal_sigma(message.baseline_cov_enu_m2 if message.mode == "moving-base" else message.position_cov_enu_m2)


def _place(message: SolutionMessage) -> str:
    if message.mode == "moving-base":
        length_m = math.sqrt(sum(part * part for part in message.baseline_enu_m))
        parts = (f"{name}{_signed(part)}" for name, part in zip("ENU", message.baseline_enu_m, strict=True))
        return f"{number(length_m, 3)} m  {' '.join(parts)}"
    if not math.isfinite(message.lat_deg):
        return message.reason or "-"
    return f"{message.lat_deg:.8f} {message.lon_deg:.8f} {message.height_m:.3f}"


def _state(word: str, track: Track[Any], now_ns: int) -> Text:
    age_s = (now_ns - track.received_ns) * 1e-9
    return coloured(word) if age_s <= SILENT_S else Text(f"{word} {age_s:.0f} s ago", style="dim")


def _latency(track: Track[Any], now_ns: int) -> str:
    quantiles = track.latency_ms.quantiles(now_ns)
    return "-" if quantiles is None else f"{quantiles.p50:.1f} (p99 {quantiles.p99:.0f})"


def _inputs(status: ServiceStatus) -> str:
    return ", ".join(source_words(row) for row in status.inputs)


def _signed(value: float) -> str:
    return f"{value:+.3f}" if math.isfinite(value) else "-"


def _pair(first: float, second: float) -> str:
    return f"{number(first, 3)} {number(second, 3)}"


def once(view: View) -> None:
    """Print the picture of this moment, in full width."""
    console = Console()
    view.width = console.width if console.is_terminal else WIDE
    Console(width=view.width).print(view.render())
