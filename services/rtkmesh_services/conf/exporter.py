"""One solver of a deployment as a .conf file of RTKLIB. What RTKLIB has no word for stands in comments."""

from dataclasses import dataclass, field
from typing import Any, Final

from rtkmesh_schemas.config import Deployment, IngestTable, OutputTable, SolverTable
from rtkmesh_services.conf.choices import Dialect
from rtkmesh_services.conf.conf_file import OURS
from rtkmesh_services.conf.export_streams import format_of, input_stream, output_stream, split_url
from rtkmesh_services.conf.rows import Row
from rtkmesh_services.conf.solver_keys import ConfLine, number_text, solver_options
from rtkmesh_services.conf.table import ALL_ROWS
from rtkmesh_services.conf.text_keys import TEXTS

_SWITCHES: Final = ("off", "on")
_USUAL: Final = {"1": "ubx", "2": "rtcm3", "3": "rtcm3"}
_SOLVERS_OWN: Final = ("sync.max_wait_s", "sync.tolerance_s", "ambiguity.failure_rate", "integrity.enabled", "integrity.risk")


@dataclass(slots=True)
class _Export:
    deployment: Deployment
    solver_id: str
    dialect: Dialect
    lines: dict[str, ConfLine] = field(default_factory=dict[str, ConfLine])
    lost: list[str] = field(default_factory=list[str])

    def say(self, key: str, value: Any, comment: str = "") -> None:
        """Enter a key, when the dialect has it."""
        if ALL_ROWS[key].known_to(self.dialect):
            self.lines[key] = ConfLine(key, _text(value), comment)
        elif _text(value):
            self.lost.append(f"{key}={_text(value)} is not in {self.dialect}")


def export_conf(deployment: Deployment, solver_id: str, dialect: Dialect, source: str) -> str:
    """Return the text of a .conf file for a solver. ``source`` is the name of the deployment's file."""
    export = _Export(deployment, solver_id, dialect)
    solver = deployment.solver[solver_id]
    for line in solver_options(solver, dialect):
        export.lines[line.key] = line
    _inputs(export, solver)
    _outputs(export)
    _base(export, solver)
    _solver_files(export, solver)
    head = f"# RTKLIB options of [solver.{solver_id}] of {source}, dialect {dialect}, {OURS}"
    body = [_written(export, row) for row in ALL_ROWS.values() if row.known_to(dialect)]
    lost = [f"# not said: {text}" for text in export.lost]
    return "\n".join([head, *lost, "", *body]) + "\n"


def _written(export: _Export, row: Row) -> str:
    """Return the line of a key: ours, or RTKLIB's default."""
    line = export.lines.get(row.name) or ConfLine(row.name, _QUIET.get(row.name, row.default_of(export.dialect)))
    if row.choices is not None and line.value in row.choices.of(export.dialect) and not line.comment:
        names = ",".join(f"{number}:{name}" for name, number in row.choices.of(export.dialect).items())
        return str(ConfLine(line.key, line.value, f"({names})"))
    return str(line)


_QUIET: Final = {"inpstr1-type": "off", "console-passwd": "", "inpstr3-format": "rtcm3", "pos1-tidecorr": "off", "pos1-soltype": "forward"}


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return _SWITCHES[value]
    return number_text(value) if isinstance(value, float | int) else str(value)


def _inputs(export: _Export, solver: SolverTable) -> None:
    ids = [solver.rover, solver.base, *[name for name in solver.navigation if name not in (solver.rover, solver.base)]]
    export.lost += [f"[ingest.{name}]: rtkrcv has three inputs" for name in ids[3:]]
    for number, name in zip("123", ids, strict=False):
        table = export.deployment.ingest.get(name)
        if table is not None:
            _input(export, number, name, table)
            _log(export, number, name)


def _input(export: _Export, number: str, name: str, table: IngestTable) -> None:
    kind, path, lost = input_stream(table.source)
    form, comment = format_of(table.observations, table.source, _USUAL[number])
    if form not in ALL_ROWS[f"inpstr{number}-format"].choices.of(export.dialect):  # pyright: ignore[reportOptionalMemberAccess]  a row of choices
        lost, form = lost or f"{export.dialect} has no decoder of {form}", _USUAL[number]
    export.say(f"inpstr{number}-type", kind)
    export.say(f"inpstr{number}-path", path, "${NAME}: write the secret there" if "${" in path else "")
    export.say(f"inpstr{number}-format", form, comment)
    export.say(f"inpstr{number}-rcvopt", table.options)
    export.say(f"file-cmdfile{number}", table.commands.file)
    export.lost += [f"[ingest.{name}] source: {lost}"] if lost else []
    export.lost += [f"[ingest.{name}] fallback: rtkrcv has one source per input"] if table.fallback else []
    if number == "2":
        _position_request(export, table)


def _position_request(export: _Export, table: IngestTable) -> None:
    scheme, _, options = split_url(table.source)
    wish = options.get("gga", "auto") if scheme.startswith("ntrip") else "off"
    place = options.get("position", "").split(",")
    if wish == "off" or (wish == "auto" and "position" not in options):
        export.say("inpstr2-nmeareq", "off", "rtkmesh asks the source table" if wish == "auto" else "")
        return
    export.say("inpstr2-nmeareq", "latlon" if len(place) > 1 else "single")
    for key, value in zip(("inpstr2-nmealat", "inpstr2-nmealon", "inpstr2-nmeahgt"), place if len(place) > 1 else [], strict=False):
        export.say(key, value)
    export.say("misc-nmeacycle", round(float(options.get("gga_period", "10")) * 1000.0))


def _log(export: _Export, number: str, name: str) -> None:
    for recorder in export.deployment.recorder.values():
        if not recorder.receivers or name in recorder.receivers:
            swap = f"::S={recorder.swap_hours:g}" if recorder.swap_hours else ""
            export.say(f"logstr{number}-type", "file")
            export.say(f"logstr{number}-path", f"{recorder.folder}/{name}_%Y%m%d%h%M.log{'::T' if recorder.tags else ''}{swap}")
            return
    for output in export.deployment.output.values():
        if output.receiver == name and output.protocol == "all":
            kind, path, _ = output_stream(output.target, export.dialect)
            export.say(f"logstr{number}-type", kind)
            export.say(f"logstr{number}-path", path)
            return


def _outputs(export: _Export) -> None:
    mine = {name: table for name, table in export.deployment.output.items() if table.solver == export.solver_id}
    levels = {name: table for name, table in mine.items() if table.format == "stat" and table.target.startswith("file://")}
    for table in levels.values():
        export.say("out-outstat", table.status_level)
        export.say("file-solstatfile", output_stream(table.target, export.dialect)[1])
    lines = [name for name in mine if name not in levels]
    export.lost += [f"[output.{name}]: rtkrcv has two outputs" for name in lines[2:]]
    for number, name in zip("12", lines, strict=False):
        _output(export, number, name, mine[name])
    if lines:
        _texts(export, lines[:2], mine)


def _output(export: _Export, number: str, name: str, table: OutputTable) -> None:
    kind, path, lost = output_stream(table.target, export.dialect)
    known = ALL_ROWS[f"outstr{number}-format"].choices.of(export.dialect)  # pyright: ignore[reportOptionalMemberAccess]  a row of choices
    if table.format not in known:
        kind, lost = "off", f"{export.dialect} has no format {table.format}"
    export.say(f"outstr{number}-type", kind)
    export.say(f"outstr{number}-path", path, "${NAME}: write the secret there" if "${" in path else "")
    export.say(f"outstr{number}-format", table.format if table.format in known else "llh")
    export.lost += [f"[output.{name}]: {lost}"] if lost else []


def _texts(export: _Export, names: list[str], tables: dict[str, OutputTable]) -> None:
    """Enter how outputs are written: each key as the first of them says it that it is of."""
    for key, (name, formats) in TEXTS.items():
        values = {output: getattr(tables[output], name) for output in names if tables[output].format in formats}
        if not values:
            continue
        value = next(iter(values.values()))
        own = {"header": {"none": "off"}, "separator": {" ": ""}}.get(name, {})
        export.say(key, own.get(value, value))
        export.lost += [f"[output.{output}] {name}: rtkrcv writes both outputs alike" for output, its in values.items() if its != value]
    first = tables[names[0]].format
    export.say("out-solformat", first if first in ("llh", "xyz", "enu", "nmea") else "llh")


def _base(export: _Export, solver: SolverTable) -> None:
    table = export.deployment.ingest.get(solver.base)
    place = (None, None) if table is None else (table.position_llh_deg, table.position_ecef_m)
    if table is not None and table.base_station is not None:
        place = (table.base_station.position_llh_deg, table.base_station.position_ecef_m)
    kind, position = ("llh", place[0]) if place[0] is not None else ("xyz", place[1])
    if position is not None:
        export.say("ant2-postype", kind)
        for axis, value in zip("123", position, strict=True):
            export.say(f"ant2-pos{axis}", f"{value:.11g}" if kind == "llh" and axis != "3" else f"{value:.4f}")
    elif table is not None and table.base_station is not None and table.base_station.mode == "average":
        export.say("ant2-postype", "single")
        export.say("ant2-maxaveep", round(table.base_station.minimum_s), "seconds, taken for epochs")
    else:
        export.say(
            "ant2-postype", "rtcm" if table is None or format_of(table.observations, table.source, "")[0] != "rinex" else "rinexhead"
        )


def _solver_files(export: _Export, solver: SolverTable) -> None:
    export.say("ant1-anttype", solver.rover_antenna or ("*" if export.dialect == "demo5" else ""))
    export.say("ant2-anttype", solver.base_antenna or ("*" if export.dialect == "demo5" else ""))
    export.say("file-rcvantfile", solver.antex, "" if solver.antex else "rtkmesh has calibrations of its own: name igs20.atx here")
    if solver.fixed_position_ecef_m is not None:
        export.say("ant1-postype", "xyz")
        for axis, value in zip("123", solver.fixed_position_ecef_m, strict=True):
            export.say(f"ant1-pos{axis}", f"{value:.4f}")
    default = SolverTable(rover="", base="")
    for path in _SOLVERS_OWN:
        table, _, name = path.partition(".")
        if (value := getattr(getattr(solver, table), name)) != getattr(getattr(default, table), name):
            export.lost.append(f"[solver.{export.solver_id}] {path} = {_text(value)}: RTKLIB has nothing like it")
