"""A .conf file -> a deployment of ours, with what became of every key."""

from collections import Counter
from dataclasses import dataclass
from typing import Any, Final

import msgspec

from rtkmesh_schemas.config import Deployment, SolverTable
from rtkmesh_services.conf.conf_file import ConfFile
from rtkmesh_services.conf.import_antennas import given_position, import_antennas
from rtkmesh_services.conf.import_inputs import import_inputs
from rtkmesh_services.conf.import_outputs import import_outputs
from rtkmesh_services.conf.import_solver import import_solver
from rtkmesh_services.conf.parser import Said
from rtkmesh_services.conf.places import Vector
from rtkmesh_services.conf.report import Became, Draft, Path, ReportRow
from rtkmesh_services.conf.rows import Fate
from rtkmesh_services.errors import ConfError
from rtkmesh_services.runtime.toml_text import toml_text

DEFAULT_ID: Final = "rtk"
_STREAMS: Final = ("inpstr1-type", "inpstr2-type", "inpstr3-type", "outstr1-type", "outstr2-type", "inpstr1-path", "inpstr2-path")


@dataclass(frozen=True, slots=True)
class Imported:
    """``streams``: whether the file has streams; one without (of rnx2rtkp) gives the table [solver] alone, for solve and load.

    ``secrets``: variables of the environment -> what the file had in their place; ``open``: variables -> what is wanted there.
    ``base_ecef_m``: where the file says that the base is.
    """

    conf: ConfFile
    tables: dict[str, Any]
    solver: SolverTable
    rows: list[ReportRow]
    said: list[Said]
    origins: dict[Path, int]
    secrets: dict[str, str]
    open: dict[str, str]
    streams: bool
    base_ecef_m: Vector | None = None

    @property
    def counts(self) -> dict[str, int]:
        """How many keys were taken, translated, ignored, and left to defaults."""
        counts = Counter(row.became for row in self.rows)
        return {became.value: counts[became] for became in Became}

    @property
    def deployment(self) -> Deployment:
        """The tables as a deployment, references to the environment as they stand there; of a solver alone: with its usual id."""
        tables = self.tables if self.streams else {"solver": {DEFAULT_ID: self.tables["solver"]}}
        return msgspec.convert(tables, Deployment)

    @property
    def toml(self) -> str:
        """The deployment, or the solver, as a file of ours."""
        return "\n".join([*self._head(), "", toml_text(self.tables)])

    def _head(self) -> list[str]:
        lines = [f"# Imported by rtkmesh conf import from {self.conf.name} (dialect {self.conf.dialect})."]
        lines += [f"# {name}: in the environment, the secret of the .conf file" for name in self.secrets]
        return lines + [f"# {name}: in the environment, such as {wanted}" for name, wanted in self.open.items()]


def import_conf(conf: ConfFile, name: str = "") -> Imported:
    """Return what a .conf file gives. ``name``: the id of the solver, and what the ids of the other processes begin with."""
    prefix = f"{name}_" if name else ""
    draft = Draft(conf, name or DEFAULT_ID, prefix)
    table = import_solver(draft)
    streams = any(key in conf.lines for key in _STREAMS)
    ingests = import_inputs(draft) if streams else []
    table = import_antennas(draft, table, ingests)
    if streams:
        import_outputs(draft, ingests)
        table = _with_inputs(draft, table, ingests)
        _withdraw_interpolation(draft)
        _console(draft)
    else:
        _without_streams(draft)
    tables = draft.tables if streams else {"solver": {**draft.tables["solver"][draft.solver_id]}}
    table = msgspec.convert(draft.tables["solver"][draft.solver_id], SolverTable)
    said = sorted(conf.said, key=lambda row: row.line or 0)
    place = None if table.mode == "moving-base" else given_position(draft, "2")
    imported = Imported(conf, _ordered(tables), table, draft.finished(), said, draft.origins, draft.secrets, draft.open, streams, place)
    _check(imported)
    return imported


def _ordered(tables: dict[str, Any]) -> dict[str, Any]:
    order = ("ingest", "solver", "attitude", "output", "recorder", "ros2")
    return {name: tables[name] for name in order if name in tables}


def _with_inputs(draft: Draft, table: SolverTable, ingests: list[str]) -> SolverTable:
    """Make the solver fit to the inputs that there are."""
    for name in ("rover", "base"):
        if draft.id_of(name) not in ingests and (name == "rover" or table.mode != "single"):
            _missing(draft, name, table)
    if draft.id_of("base") in ingests:
        return table
    draft.put(("solver", draft.solver_id, "base"), "")
    if table.mode == "single":
        return msgspec.structs.replace(table, base="")
    draft.put(("solver", draft.solver_id, "mode"), "single", "inpstr2-type")
    return msgspec.structs.replace(table, base="", mode="single")


def _withdraw_interpolation(draft: Draft) -> None:
    """Take out what is possible in recordings alone, where an input is live or the base does not stand."""
    solver: dict[str, Any] = draft.tables["solver"][draft.solver_id]
    sync: dict[str, Any] = solver.get("sync", {})
    recorded = all(table.get("source", "").startswith("file://") for table in draft.tables.get("ingest", {}).values())
    if "interpolate" not in sync or (recorded and solver["mode"] not in ("single", "moving-base")):
        return
    del sync["interpolate"]
    draft.note("misc-timeinterp", Fate.IGNORED, "", "of recordings with a base that stands: live no later base epoch is known", alters=True)


def _missing(draft: Draft, name: str, table: SolverTable) -> None:
    number = {"rover": "1", "base": "2"}[name]
    if name == "base":
        why = f"without a base RTKLIB gives single positions in mode {table.mode}; here the mode is single"
        draft.note("inpstr2-type", Fate.TRANSLATED, f"solver.{draft.solver_id}.mode", why, alters=True)
        return
    id_ = draft.id_of(name)
    url = draft.placeholder(f"{id_}_source", "tcp://HOST:PORT, serial:///dev/ttyACM0 or file://LOG")
    draft.put(("ingest", id_, "source"), url, f"inpstr{number}-type")
    draft.note(f"inpstr{number}-type", Fate.TRANSLATED, f"ingest.{id_}.source", f"off: say it in the environment, {url}", alters=True)


def _console(draft: Draft) -> None:
    text = draft.conf.text("console-passwd")
    why = "rtkrcv's console has its own table, [telnet.ID]: say the password there, as ${RTKMESH_CONSOLE_PASSWORD}"
    draft.note("console-passwd", Fate.TRANSLATED, "telnet", why if text else "no password")


def _without_streams(draft: Draft) -> None:
    """Say that a file of rnx2rtkp has no streams: its keys of outputs are flags of rtkmesh solve."""
    for key in ("out-solformat", "out-timeform"):
        draft.note(key, Fate.TRANSLATED, "", "of rtkmesh solve: --format, --time-form")
    for key in ("out-outhead", "out-outopt", "out-outvel", "out-timesys", "out-timendec", "out-degform", "out-fieldsep", "out-outsingle"):
        draft.note(key, Fate.IGNORED, "", "the file has no stream: an [output] has it")
    for key in ("out-maxsolstd", "out-height", "out-nmeaintv1", "out-nmeaintv2", "out-outstat", "file-solstatfile"):
        draft.note(key, Fate.IGNORED, "", "the file has no stream: an [output] has it")


def _check(imported: Imported) -> None:
    """ConfError if what was made is no deployment: a fault of ours, not of the file."""
    try:
        _ = imported.deployment
    except msgspec.ValidationError as error:
        raise ConfError(f"{imported.conf.name}: gives no deployment: {error}") from error
