"""``rtkmesh demo``: the main job on simulated receivers, with the truth beside it."""

import math
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import numpy as np
from cyclopts import Parameter
from numpy.typing import NDArray

from rtkmesh.gnss.time import GpsTime
from rtkmesh_schemas.attitude import AttitudeMessage
from rtkmesh_schemas.config import Deployment
from rtkmesh_schemas.solution import SolutionMessage
from rtkmesh_schemas.status import State
from rtkmesh_services.cli.board import FIX, Board
from rtkmesh_services.cli.network import Json
from rtkmesh_services.cli.page import command_page
from rtkmesh_services.cli.table import Truth, View
from rtkmesh_services.cli.up import EXIT_FAILED, Foreground, print_json
from rtkmesh_services.control.endpoints import free_port, is_free
from rtkmesh_services.control.fleet import LaunchOptions
from rtkmesh_services.runtime.configuration import load_site
from rtkmesh_services.runtime.kernel_cache import use_kernel_cache
from rtkmesh_services.runtime.process import leave
from rtkmesh_services.runtime.shipped import config_path

if TYPE_CHECKING:
    from rtkmesh.simulation.scenario import Truth as SimulatedTruth

FIRST_FIX_WITHIN_S: Final = 60.0
POSITION_ID, HEADING_ID = "rtk", "heading"
_ENDPOINT: Final = "tcp/127.0.0.1:7547"
TruthAt = Callable[[GpsTime], "SimulatedTruth"]
_SIMULATED: Final = re.compile(r"(?P<where>sim://[a-z0-9_]+/[a-z0-9_]+)\?[^\"]*")


def demo(
    *,
    seconds: Annotated[float, Parameter(help="End after this time; 0: at Ctrl-C.")] = 0.0,
    as_json: Json = False,
    rate: Annotated[float, Parameter(help="Epochs per second of every receiver.")] = 5.0,
    seed: Annotated[int, Parameter(help="Another seed: other noise, other slips.")] = 1,
) -> None:
    """Run everything on simulated receivers: a vehicle with two antennas and a base station.

    One process per role: hub, three ingests that get the bytes of real receivers (UBX, RTCM 3), a kinematic solver, a
    moving-base solver, attitude, control. The table has the truth beside it. With --json one object at the end.

    Exit codes: 0 done, 1 no fix within 60 seconds (or none before the end), 2 the site is at fault.
    """
    if is_cold():
        sys.stderr.write("compiling the engine's kernels: only the first time\n")
        subprocess.run([sys.executable, "-m", "rtkmesh_services.cli.main", "warm"], stdout=sys.stderr, check=False)
    with tempfile.TemporaryDirectory(prefix="rtkmesh-demo-") as folder:
        file = Path(folder) / "demo.toml"
        file.write_text(deployment_text(rate, seed))
        site = load_site(file)
        board = Board()
        score = Score(lambda: truth_of(site.deployment, seed))
        board.on_solution, board.on_attitude = score.solution, score.attitude
        view = View(board, "rtkmesh demo", truth=Truth(score.position_error, score.heading_error), note=score.note)
        foreground = Foreground(
            site, LaunchOptions(file), quiet=as_json, board=board, view=view, prepare=score.prepare, ends=Enough(seconds, score)
        )
        code = foreground.run()
    summary = score.summary(foreground)
    if as_json:
        print_json(summary)
    else:
        sys.stdout.write(in_words(summary))
    leave(code or (0 if score.fixes else EXIT_FAILED))


def is_cold() -> bool:
    """Whether no kernel is in the cache yet: five processes would then compile the same ones at once."""
    folder = use_kernel_cache()
    return next(folder.rglob("*.nbi"), None) is None


def deployment_text(rate_hz: float, seed: int) -> str:
    """Return the demo's deployment with a free port, the rate and the seed."""
    text = config_path("demo.toml").read_text()
    if not is_free(_ENDPOINT):
        text = text.replace(_ENDPOINT, f"tcp/127.0.0.1:{free_port()}")
    return _SIMULATED.sub(rf"\g<where>?rate={rate_hz:g}&seed={seed}", text)


@dataclass(slots=True)
class Enough:
    """When the demo ends by itself: after its seconds, or without a fix in time."""

    seconds: float
    score: "Score"
    started_s: float = field(default_factory=time.monotonic)
    solving_s: float | None = None

    def __call__(self, foreground: Foreground) -> tuple[str, int] | None:
        """Return (why, exit code) when it is enough."""
        now_s = time.monotonic()
        status = foreground.board.statuses.get(POSITION_ID)
        if self.solving_s is None and status is not None and status[0].state not in (State.STARTING, State.WARMING):
            self.solving_s = now_s
        if not self.score.fixes and self.solving_s is not None and now_s - self.solving_s > FIRST_FIX_WITHIN_S:
            return f"no fix within {FIRST_FIX_WITHIN_S:.0f} s", EXIT_FAILED
        if self.seconds and now_s - self.started_s >= self.seconds:
            return f"the {self.seconds:g} s are over", 0
        return None


def truth_of(deployment: Deployment, seed: int) -> dict[str, tuple[TruthAt, str]]:
    """Return, for each ingest, its scenario's truth and its antenna."""
    from rtkmesh.simulation.scenario import truth

    names = {id_: table.source.removeprefix("sim://").partition("?")[0].split("/") for id_, table in deployment.ingest.items()}
    truths = {scenario: truth(scenario, seed=seed) for scenario, _ in names.values()}
    return {id_: (truths[scenario], antenna) for id_, (scenario, antenna) in names.items()}


class Score:
    """Errors against the truth, latencies and the time to the first fix."""

    def __init__(self, truth: Callable[[], dict[str, tuple[TruthAt, str]]]) -> None:
        self._load_truth = truth
        self._truth: dict[str, tuple[TruthAt, str]] = {}
        self.epochs = self.fixes = 0
        self._started_s = time.monotonic()
        self._first: GpsTime | None = None
        self._time_to_fix_s = self._start_to_fix_s = math.nan
        self._errors: list[tuple[float, float, float]] = []
        self._headings: list[float] = []
        self._latencies: list[float] = []

    def prepare(self) -> None:
        """Load the truth: it needs the engine, whose import would hold up the start of the processes."""
        self._truth = self._load_truth()

    def solution(self, id_: str, message: SolutionMessage, latency_ms: float) -> None:
        """Take a solution of the positioning solver."""
        if id_ != POSITION_ID:
            return
        now = GpsTime(message.week, message.tow_s)
        self._first = self._first or now
        self.epochs += 1
        if math.isfinite(latency_ms):
            self._latencies.append(latency_ms)
        if message.status != FIX:
            return
        self.fixes += 1
        if self.fixes == 1:
            self._time_to_fix_s, self._start_to_fix_s = now - self._first, time.monotonic() - self._started_s
        if (error := self.position_error(id_, message)) is not None:
            self._errors.append(error)

    def attitude(self, id_: str, message: AttitudeMessage, latency_ms: float) -> None:  # noqa: ARG002  the board's form
        """Take an attitude."""
        if message.integrity == "ok" and (error := self.heading_error(id_, message)) is not None:
            self._headings.append(error)

    def position_error(self, _id: str, message: SolutionMessage) -> tuple[float, float, float] | None:
        """Return the error of the position, or of the moving baseline, east, north and up in metres."""
        from rtkmesh.gnss.frames import enu_from_ecef_at

        rover, base = self._truth.get(message.rover), self._truth.get(message.base)
        moving = message.mode == "moving-base"
        found_ecef_m = message.baseline_ecef_m if moving else message.position_ecef_m
        if rover is None or (moving and base is None) or not math.isfinite(found_ecef_m[0]):
            return None
        there = rover[0](_true_time(message)).antennas_ecef_m
        true_ecef_m = there[rover[1]] - there[base[1]] if moving and base is not None else there[rover[1]]
        east, north, up = enu_from_ecef_at(there[rover[1]]) @ (np.array(found_ecef_m) - true_ecef_m)
        return float(east), float(north), float(up)

    def heading_error(self, _id: str, message: AttitudeMessage) -> float | None:
        """Return the error of the heading, degrees."""
        if not math.isfinite(message.heading_rad) or not self._truth:
            return None
        truth, _ = next(iter(self._truth.values()))
        difference = message.heading_rad - truth(GpsTime(message.week, message.tow_s)).heading_rad
        return math.degrees(math.remainder(difference, math.tau))

    def note(self) -> str:
        """Return the line above the table."""
        if not self.epochs:
            return "processes are starting"
        if not self.fixes:
            return f"no fix yet, {self.epochs} epochs"
        return f"first fix after {self._time_to_fix_s:.1f} s, {100.0 * self.fixes / self.epochs:.1f} % of {self.epochs} epochs fixed"

    def summary(self, foreground: Foreground) -> dict[str, Any]:
        """Return the run in figures; None where there is nothing to count."""
        errors = np.array(self._errors).reshape(-1, 3)
        return {
            "seconds": round(foreground.seconds, 2),
            "reason": foreground.reason,
            "epochs": self.epochs,
            "fix_pct": _rounded(100.0 * self.fixes / self.epochs if self.epochs else math.nan, 2),
            "ttff_s": _rounded(self._time_to_fix_s, 2),
            "start_to_fix_s": _rounded(self._start_to_fix_s, 2),
            "horizontal_rms_m": _rounded(_rms(np.hypot(errors[:, 0], errors[:, 1])), 4),
            "vertical_rms_m": _rounded(_rms(errors[:, 2]), 4),
            "worst_horizontal_m": _rounded(float(np.hypot(errors[:, 0], errors[:, 1]).max()) if len(errors) else math.nan, 4),
            "heading_epochs": len(self._headings),
            "heading_rms_deg": _rounded(_rms(np.array(self._headings)), 3),
            "latency_p50_ms": _rounded(_quantile(self._latencies, 50), 2),
            "latency_p99_ms": _rounded(_quantile(self._latencies, 99), 2),
            "processes": len(foreground.rows) + 1,
            "restarts": sum(row["restarts"] for row in foreground.rows),
        }


def in_words(summary: dict[str, Any]) -> str:
    """Return the summary for people."""
    if not summary["epochs"]:
        return "no solution came: see the log above\n"
    if summary["ttff_s"] is None:
        return f"no fix in {summary['epochs']} epochs\n"
    lines = [
        f"{summary['epochs']} epochs, {summary['fix_pct']} % fixed",
        f"first fix after {summary['ttff_s']} s of data, {summary['start_to_fix_s']} s after the start of the demo",
        f"position error of fixed epochs: {summary['horizontal_rms_m']} m horizontal, {summary['vertical_rms_m']} m vertical (rms)",
        f"heading error: {summary['heading_rms_deg']} deg (rms of {summary['heading_epochs']} epochs)",
        f"latency, last byte in to solution here: {summary['latency_p50_ms']} ms (p50), {summary['latency_p99_ms']} ms (p99)",
        f"{summary['processes']} processes, {summary['restarts']} restarts",
    ]
    return "\n".join(lines) + "\n"


def _true_time(message: SolutionMessage) -> GpsTime:
    """Return when the rover's signals really were received: the epoch's tag is of the receiver's clock."""
    clock_s = message.receiver_clock_s if math.isfinite(message.receiver_clock_s) else 0.0
    return GpsTime(message.week, message.tow_s) + -clock_s


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else math.nan


def _quantile(values: list[float], percent: float) -> float:
    return float(np.percentile(values, percent)) if values else math.nan


def _rounded(value: float, digits: int) -> float | None:
    return round(value, digits) if math.isfinite(value) else None


app = command_page(
    demo,
    """
    rtkmesh demo
    rtkmesh demo --seconds 30 --json
    rtkmesh demo --rate 10 --seed 7
    """,
)
