"""What became of the keys of a .conf file, for people and as JSON."""

import sys
from typing import Any

import msgspec

from rtkmesh_services.conf.importer import Imported
from rtkmesh_services.conf.report import Became, ReportRow


def print_report(imported: Imported, *, every: bool = False) -> None:
    """Write the report to standard error: first what needs somebody's eye."""
    conf = imported.conf
    lines = [f"{conf.name}: dialect {conf.dialect}: {conf.guess.why}"]
    if conf.guess.against:
        lines.append(f"  but: {conf.guess.against}; say --dialect if that is the right one")
    lines += ["", "lines that are not understood:"] * bool(conf.wrong) + [row.shown(conf.name) for row in conf.wrong]
    others = [row for row in imported.said if not row.wrong]
    lines += ["", "noted:"] * bool(others) + [row.shown(conf.name) for row in others]
    altered = [row for row in imported.rows if row.alters]
    lines += ["", "asked for by the file and not done:"] * bool(altered) + [_line(conf.name, row) for row in altered]
    if every:
        lines += ["", "every key:", *(_line(conf.name, row) for row in imported.rows)]
    wanted = [*imported.secrets, *imported.open]
    lines += ["", f"to be said in the environment: {', '.join(wanted)}"] * bool(wanted)
    lines += ["", counted(imported)]
    sys.stderr.write("\n".join(lines) + "\n")


def counted(imported: Imported) -> str:
    """Return how many keys became what."""
    said = len(imported.rows) - imported.counts[Became.DEFAULT]
    rest = ", ".join(f"{count} {name}" for name, count in imported.counts.items() if name != Became.DEFAULT)
    return f"{said} keys: {rest}; {imported.counts[Became.DEFAULT]} more left to RTKLIB's defaults"


def _line(file: str, row: ReportRow) -> str:
    where = f"{file}:{row.line}: " if row.line else f"{file}: "
    target = f" -> {row.target}" if row.target and row.became is not Became.IGNORED else ""
    return f"{where}{row.key}={row.value} {row.became}{target}{f': {row.note}' if row.note else ''}"


def report_json(imported: Imported) -> dict[str, Any]:
    """Return the report and what was made as JSON has it."""
    conf = imported.conf
    return {
        "file": conf.name,
        "dialect": {"name": conf.dialect, "why": conf.guess.why, "against": conf.guess.against},
        "counts": imported.counts,
        "keys": [msgspec.to_builtins(row) for row in imported.rows],
        "said": [msgspec.to_builtins(row) for row in imported.said],
        "environment": {"secrets": list(imported.secrets), "open": imported.open},
        "deployment" if imported.streams else "solver_file": imported.tables,
    }
