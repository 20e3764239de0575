"""What an epoch costs here and in RTKLIB: the same recordings with the same systems and bands, one after the other, processor time alone.

The engines by themselves: ``Session.solve`` here, demo5's ``rtkpos`` (PyPI pyrtklib5) in a process of its own; every epoch is timed, of
some runs its least counts, and the first epochs (cold caches, a filter that begins) do not. b34 and ``rtkmesh solve`` are processes that
also start, read and write: b34 reads the whole file but solves half of the epochs (``-te``), then all; what the second run costs more is
solving alone. ``rtkmesh solve`` gets half of the rover's file, then all: what that costs more is decoding, solving and writing.
"""

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final
from unittest.mock import patch

import recorded
import rtklib
from cases import Case
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.options import RtkOptions
from rtkmesh.rtk.session import Session
from rtkmesh.rtk.solution import Status

WARM: Final = 5
REPEATS: Final = 3
_HERE = Path(__file__).resolve().parent
_PROGRAM: Final = [sys.executable, "-m", "rtkmesh_services.cli.main"]


@dataclass(frozen=True, slots=True)
class Epochs:
    """Milliseconds of every epoch, and what came of them."""

    ms: list[float]
    fixes: int
    times: list[GpsTime]

    @property
    def mean_ms(self) -> float:
        """Mean without the first epochs."""
        return sum(self.ms[WARM:]) / len(self.ms[WARM:])


@dataclass(frozen=True, slots=True)
class Slope:
    """A process per epoch, and what it costs before the first one (s)."""

    ms: float
    start_s: float


def ours(case: Case) -> Epochs:
    """Return the engine's epochs: of some runs the least of each."""
    runs, solutions = list[list[float]](), []
    for _ in range(REPEATS):
        used_ms = list[float]()
        with patch.object(Session, "solve", timed(Session.solve, used_ms)):
            solutions = recorded.solutions(case, RtkOptions(systems=case.systems, frequencies=case.frequencies))
        runs.append(used_ms)
    least_ms = [min(epoch) for epoch in zip(*runs, strict=True)]
    return Epochs(least_ms, sum(one.status is Status.FIX for one in solutions), [one.time for one in solutions])


def timed(function: Callable[..., Any], used_ms: list[float]) -> Callable[..., Any]:
    """Return the function that also notes the processor time that it took."""

    def call(*args: Any, **kwargs: Any) -> Any:
        begun = time.thread_time()
        result = function(*args, **kwargs)
        used_ms.append(1e3 * (time.thread_time() - begun))
        return result

    return call


def demo5(case: Case, data: Path) -> Epochs:
    """Return demo5's epochs, measured in a process of its own."""
    argv = [sys.executable, str(_HERE / "demo5_speed.py"), case.name, "--data", str(data), "--repeats", str(REPEATS)]
    said = subprocess.run(argv, check=True, capture_output=True, text=True).stdout
    told = json.loads(said.splitlines()[-1])
    return Epochs(told["ms"], told["fixes"], [])


def b34(case: Case, times: list[GpsTime]) -> Slope:
    """Return rnx2rtkp's solving."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        files, half = rtklib.rinex(case, folder), len(times) // 2
        until = times[half - 1].to_calendar()
        argv = rtklib.command(case, files, folder, folder / "out.pos")
        flags = ["-te", f"{until:%Y/%m/%d}", f"{until:%H:%M:%S.%f}"]
        return slope(least_cpu_s([*argv[:1], *flags, *argv[1:]]), least_cpu_s(argv), half, len(times))


def solving(case: Case) -> Slope:
    """Return ``rtkmesh solve``: decoding, solving, writing."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rover = rtklib.plain(case.rover, folder)
        part, content = folder / ("half" + rover.suffix), rover.read_bytes()
        part.write_bytes(content[: content.index(b"\n", len(content) // 2) + 1])
        ends = [(least_cpu_s(solve_command(case, file, folder)), epochs_of(case, file, folder)) for file in (part, rover)]
        return slope(ends[0][0], ends[1][0], ends[0][1], ends[1][1])


def solve_command(case: Case, rover: Path, folder: Path) -> list[str]:
    """Return the command line that solves a case with this rover file."""
    argv = [*_PROGRAM, "solve", "--rover", str(rover), "--base", str(case.base), "--json", "--out", str(folder / "ours.pos")]
    argv += ["--frequencies", str(case.frequencies), "--systems", case.systems, "--base-ecef=" + ",".join(map(str, case.base_ecef_m))]
    argv += [part for file in case.navigation for part in ("--nav", str(file))]
    return argv + (["--date", case.date] if case.date else [])


def epochs_of(case: Case, rover: Path, folder: Path) -> int:
    """Return how many epochs ``rtkmesh solve`` finds."""
    return int(json.loads(rtklib.run(solve_command(case, rover, folder)).output)["epochs"])


def least_cpu_s(argv: list[str]) -> float:
    """Return the least processor time of some runs."""
    return min(rtklib.run(argv).cpu_s for _ in range(REPEATS))


def slope(part_s: float, whole_s: float, part: int, whole: int) -> Slope:
    """Return what an epoch costs by two runs over parts of one file."""
    per_epoch_s = (whole_s - part_s) / (whole - part)
    return Slope(1e3 * per_epoch_s, whole_s - whole * per_epoch_s)


def row(case: Case, data: Path) -> str:
    """Return the line of a case."""
    mine, peer = ours(case), demo5(case, data)
    older, process = b34(case, mine.times), solving(case)
    fixes = f"{100 * mine.fixes / case.epochs:.0f} / {100 * peer.fixes / case.epochs:.0f}"
    cells = (
        case.name, f"{case.frequencies} {case.systems}", fixes, f"{mine.mean_ms:.3f}", f"{peer.mean_ms:.3f}", f"{older.ms:.3f}",
        f"{mine.mean_ms / peer.mean_ms:.2f}", f"{mine.mean_ms / older.ms:.2f}", f"{process.ms:.2f}", f"{process.start_s:.1f}",
    )  # fmt: skip
    return f"| {' | '.join(cells)} |"


HEAD: Final = (
    "| recording | bands, systems | fixed %: ours / demo5 | ours, ms | demo5 2.5.0, ms | b34, ms | ours : demo5 | ours : b34 | "
    "`rtkmesh solve`, ms | its start, s |\n|---|---|---|---|---|---|---|---|---|---|"
)


def page(cases: list[Case], data: Path) -> None:
    """Print the table, line by line as it is measured."""
    print(HEAD, flush=True)
    for case in cases:
        print(row(case, data), flush=True)
