"""What ``rtkmesh solve`` shows: a progress bar on a terminal, a summary table on standard error, or JSON on standard output.

What draws is imported when it draws: that takes longer than solving a hundred epochs.
"""

import json
import sys
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final, Self

from rtkmesh.rtk.solution import Reason, Status
from rtkmesh_services.cli.offline import Run, SolutionType

if TYPE_CHECKING:
    from rich.progress import Progress
    from rich.table import Table

_DRAW_EVERY: Final = 50  # epochs
_HINTS: Final = {
    Reason.NO_BASE_POSITION: " (say --base-llh LAT,LON,H or --base-ecef X,Y,Z)",
    Reason.NO_EPHEMERIS: " (give a recording that has navigation data with --nav)",
}


class ProgressBar:
    """A bar over all ways through the recordings, on standard error; draws nothing unless ``shown``."""

    def __init__(self, run: Run, *, shown: bool) -> None:
        self._run, self._countdown = run, 1
        run.watch = self.advance
        self._progress: Progress | None = None
        if shown:
            from rtkmesh_services.cli.progress import bar

            self._progress = bar()

    def __enter__(self) -> Self:
        if self._progress is not None:
            self._task = self._progress.add_task("solving", total=1.0)
            self._progress.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._progress is not None:
            self._progress.stop()

    def advance(self) -> None:
        """Count one epoch; draw now and then."""
        self._countdown -= 1
        if self._progress is None or self._countdown > 0:
            return
        self._countdown = _DRAW_EVERY
        self._progress.update(self._task, completed=self._run.progress, description=self._text())

    def _text(self) -> str:
        tally, turned = self._run.tally, self._run.turned
        if self._run.kind is SolutionType.FORWARD or (turned and self._run.kind is SolutionType.BACKWARD):
            return f"{tally.epochs} epochs, {tally.percent(Status.FIX):.1f} % fixed"
        return f"backward, {100.0 * turned:.0f} %" if turned else "forward"


def report(run: Run, *, as_json: bool, quiet: bool) -> None:
    """Print the summary; what the recordings held that could not be used is part of it."""
    if as_json:
        sys.stdout.write(json.dumps({**_figures(run), "antennas": _antennas(run), "rejected": run.faults()}, indent=1) + "\n")
    elif not quiet:
        from rich.console import Console

        Console(stderr=True).print(_table(run))


def _figures(run: Run) -> dict[str, Any]:
    """Return the figures of what was written, and where two ways were combined, of each, with how many epochs were combined how."""
    figures: dict[str, Any] = {"direction": run.kind.value, **run.tally.as_dict()}
    if run.passes:
        figures |= {"directions": {kind.value: tally.as_dict() for kind, tally in run.passes.items()}, "combined": run.combined}
    return figures


def _antennas(run: Run) -> dict[str, str | bool]:
    return {**run.session.antennas, "corrected": run.session.corrects_antennas}


def _table(run: Run) -> "Table":
    from rich.table import Table

    tally = run.tally
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_row("epochs", str(tally.epochs))
    if run.kind is not SolutionType.FORWARD:
        table.add_row("direction", run.kind.value)
    for status in (Status.FIX, Status.FLOAT, Status.DGPS, Status.SINGLE, Status.NONE):
        if tally.statuses[status]:
            table.add_row(status.name.lower(), f"{tally.percent(status):.1f} %")
    for kind, one in run.passes.items():
        table.add_row(f"fixed {kind.value}", f"{one.percent(Status.FIX):.1f} %")
    if run.combined:
        table.add_row("combined", ", ".join(f"{name.replace('_', ' ')} {count}" for name, count in run.combined.items()))
    if tally.first_fix_s is not None:
        table.add_row("first fix", f"after {tally.first_fix_s:.1f} s")
    table.add_row("largest age", f"{tally.largest_age_s:.1f} s")
    if tally.resets:
        table.add_row("filter resets", str(tally.resets))
    table.add_row("solving", f"{1e3 * tally.solving_s / max(1, tally.epochs):.2f} ms an epoch, {tally.total_s:.1f} s in all")
    for end, name in run.session.antennas.items():
        if name:
            table.add_row(f"{end} antenna", name if run.session.corrects_antennas else f"{name} (not corrected: both must be known)")
    for reason, count in tally.reasons.most_common(4):
        table.add_row("why not RTK", f"{reason.name.lower().replace('_', ' ')}: {count} epochs{_HINTS.get(reason, '')}")
    for name, counts in run.faults().items():
        for reason, count in sorted(counts.items(), key=lambda item: -item[1])[:3]:
            table.add_row("rejected", f"{name}: {reason} ({count})")
    return table
