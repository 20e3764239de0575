"""Measured figures into pages: the tables of RESULTS.md and the block of README.md, each between its pair of markers."""

import platform
import re
import subprocess
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from cases import REPOSITORY, Case
from rtkmesh import __version__

Row = dict[str, Any]
Report = dict[str, dict[str, Row]]

RESULTS: Final = REPOSITORY / "benchmarks" / "RESULTS.md"
README: Final = REPOSITORY / "README.md"

_COLUMNS: Final = (
    "solved by", "solutions", "fix %", "right %", "wrong", "longest wrong run", "h50 / h95 m", "v50 / v95 m", "where both fix: h95 / v95 m",
    "first fix s",     "CPU ms/epoch, process", "ms/epoch, solving",
)  # fmt: skip


class MarkerError(Exception):
    """A page without its markers."""


def fill(page: Path, name: str, text: str) -> None:
    """Replace what stands between ``<!-- name -->`` and ``<!-- /name -->``."""
    pattern = rf"(?s)(<!-- {name} -->\n).*?(<!-- /{name} -->)"
    filled, count = re.subn(pattern, lambda match: match[1] + text.rstrip("\n") + "\n" + match[2], page.read_text())
    if count != 1:
        raise MarkerError(f"{page}: {count} blocks <!-- {name} --> instead of one")
    page.write_text(filled)


def made() -> str:
    """Return when, with what and on what the figures were made."""
    day = datetime.now(UTC).strftime("%Y-%m-%d")
    return f"Made {day} with rtkmesh {__version__}{_commit()}, Python {platform.python_version()}, on {_processor()}."


def _commit() -> str:
    """Return the commit in brackets, with a plus when files other than the pages of results differ from it; nothing outside a checkout."""
    git = ["git", "-C", str(REPOSITORY)]
    pages = [f":!{page.relative_to(REPOSITORY).as_posix()}" for page in (RESULTS, README)]
    try:
        name = subprocess.run([*git, "describe", "--always", "--exclude=*"], capture_output=True, text=True, check=True).stdout.strip()
        differs = subprocess.run([*git, "diff", "--quiet", "HEAD", "--", ".", *pages], check=False).returncode
    except (OSError, subprocess.CalledProcessError):
        return ""
    return f" ({name}{'+' if differs else ''})"


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return f"{len(names)} x {names[0]}" if names else platform.machine()


def table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = ["| " + " | ".join(cells) + " |" for cells in (columns, *rows)]
    return "\n".join([lines[0], "|" + "---|" * len(columns), *lines[1:]]) + "\n"


def accuracy_page(report: Report, cases: Sequence[Case], titles: dict[str, str]) -> str:
    """Return one table per case."""
    parts = [made() + "\n"]
    for case in cases:
        kind = f"{case.epochs} epochs, {case.frequencies} frequencies, {case.systems}, errors against: {case.against}"
        rows = [_cells(titles[name], row) for name, row in report[case.name].items()]
        parts.append(f"### {case.name}\n{kind}\n\n{table(_COLUMNS, rows)}")
    return "\n".join(parts)


def _cells(title: str, row: Row) -> list[str]:
    if "failed" in row:
        return [title, "failed: " + row["failed"].replace("|", "/").replace("\n", " "), *[""] * (len(_COLUMNS) - 2)]
    numbers = [_number(row.get(name), form) for name, form in (("right_fix_pct", ".1f"), ("wrong_fixes", "d"), ("longest_wrong_run", "d"))]
    costs = [_number(row.get(name), ".2f") for name in ("cpu_ms_per_epoch", "solve_ms_per_epoch")]
    errors = [_errors(row.get(f"{axis}_fixed")) for axis in ("h", "v")]
    common = _common(row.get("common"))
    return [title, str(row["solutions"]), _number(row["fix_pct"], ".1f"), *numbers, *errors, common, _number(row["ttff_s"], ".0f"), *costs]


def _number(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)


def _errors(row: Row | None) -> str:
    return f"{row['p50']:.3f} / {row['p95']:.3f}" if row else ""


def _common(row: Row | None) -> str:
    """Return the errors at epochs that both programs have fixed, to a tenth of a millimetre, and their number."""
    return f"{row['h']['p95']:.4f} / {row['v']['p95']:.4f} ({row['count']})" if row else ""


def accuracy_summary(report: Report, cases: Sequence[Case], titles: dict[str, str], behind: Sequence[str]) -> str:
    """Return the short table of the README: right fixes, wrong fixes and cost beside rnx2rtkp, and where we are behind it."""
    columns = ["recording", "right fixes %", "", "wrong fixes", "", "h95 / v95 m", "", "CPU ms/epoch", ""]
    rows: list[list[str]] = [["", *["rtkmesh", "RTKLIB"] * 4]]
    names = list(titles)[:2]
    for case in cases:
        pair = [report[case.name].get(name, {}) for name in names]
        cells = [[_right(row) for row in pair], [_number(row.get("wrong_fixes"), "d") for row in pair]]
        cells += [[_p95(row) for row in pair], [_number(row.get("cpu_ms_per_epoch"), ".2f") for row in pair]]
        mark = " †" if case.against == "own median" else ""
        rows.append([f"{case.name} ({case.epochs}){mark}", *[cell for both in cells for cell in both]])
    confession = f" Behind rnx2rtkp: {'; '.join(behind)}." if behind else ""
    return f"{table(columns, rows)}\n{made()}{confession}\n"


def _right(row: Row) -> str:
    """Return the share of right fixes; where nobody knows which are right, that of fixes in brackets."""
    if "right_fix_pct" in row:
        return format(row["right_fix_pct"], ".1f")
    return f"({row['fix_pct']:.1f})" if "fix_pct" in row else "failed"


def _p95(row: Row) -> str:
    return f"{row['h_fixed']['p95']:.3f} / {row['v_fixed']['p95']:.3f}" if row.get("h_fixed") else ""
