"""``rtkmesh check``: every fault of a deployment file at once."""

import sys
from collections.abc import Callable
from datetime import date
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
from cyclopts import Parameter

from rtkmesh_schemas.config import CommandsTable, Deployment, IngestTable
from rtkmesh_schemas.errors import ConfigError
from rtkmesh_services.cli.network import EXIT_OK, EXIT_USAGE, Json
from rtkmesh_services.cli.page import command_page
from rtkmesh_services.errors import SourceError

if TYPE_CHECKING:
    from rtkmesh_services.ingest.urls import SourceUrl


def check(
    file: Annotated[Path, Parameter(help="The deployment file (TOML), or a .conf file of RTKLIB.")],
    /,
    *,
    data: Annotated[Path | None, Parameter(help="Folder of the recordings: what {data} stands for.")] = None,
    as_json: Json = False,
) -> int:
    """Check a deployment file: every fault with its line, the key, the allowed values and the nearest right name.

    Of a .conf file of RTKLIB: every line that RTKLIB would pass over in silence.

    Exit codes: 0 right, 2 faults.
    """
    from rtkmesh_services.runtime.attitude_checks import notes_on
    from rtkmesh_services.runtime.configuration import ConfigErrors, load_site

    errors: list[ConfigError] = []
    deployment: Deployment | None = None
    try:
        if file.suffix == ".conf":
            errors, deployment = _conf_errors(file)
        else:
            deployment = load_site(file, data).deployment
    except ConfigErrors as error:
        errors = error.errors
    else:
        errors = errors if file.suffix == ".conf" else url_errors(file, deployment, simulations=True)
    notes = [] if deployment is None else [note for id_, table in deployment.attitude.items() for note in notes_on(id_, table, deployment)]
    if as_json:
        rows = [{"file": error.file, "line": error.line, "message": error.message} for error in errors]
        told = {"ok": not errors, "errors": rows, "notes": notes, "processes": _processes(deployment)}
        sys.stdout.write(msgspec.json.encode(told).decode() + "\n")
    else:
        for error in errors:
            sys.stderr.write(f"{error}\n")
        if not errors and deployment is not None:
            rows = _processes(deployment)
            sys.stdout.write(f"{file}: right; {len(rows)} processes: {', '.join(row['id'] for row in rows)}\n")
            sys.stdout.writelines(f"note: {note}\n" for note in notes)
    return EXIT_USAGE if errors else EXIT_OK


def _conf_errors(file: Path) -> tuple[list[ConfigError], Deployment]:
    """Return what is wrong in a .conf file, and the deployment that it gives."""
    from rtkmesh_services.conf.conf_file import read_conf
    from rtkmesh_services.conf.importer import import_conf

    imported = import_conf(read_conf(file))
    errors = [ConfigError(str(file), row.line, row.message) for row in imported.conf.wrong]
    return errors, imported.deployment


def url_errors(file: Path, deployment: Deployment, *, simulations: bool = False) -> list[ConfigError]:
    """Return the faults of the sources and targets: their URLs and dates, and recordings that are not there.

    ``simulations``: also what the simulator does not have, which costs a second for loading it.
    """
    from rtkmesh_services.output.targets import check_output
    from rtkmesh_services.runtime.logs import clean
    from rtkmesh_services.runtime.toml_lines import lines_of

    lines = lines_of(file.read_text())
    errors: list[ConfigError] = []

    def examine(path: tuple[str, str, str], look: Callable[[], object]) -> None:
        try:
            look()
        except SourceError as error:
            errors.append(ConfigError(str(file), lines.get(path), f"[{path[0]}.{path[1]}] {path[2]}: {clean(str(error))}"))

    for id, source in deployment.ingest.items():  # noqa: A001  the word of the design
        examine(("ingest", id, "source"), partial(_look_at_source, source.source, simulations))
        for index, url in enumerate(source.fallback):
            examine(("ingest", id, "fallback"), partial(_look_at_fallback, source.source, url, index))
        folder = file.parent / deployment.deployment.config_folder
        examine(("ingest", id, "commands"), partial(_look_at_commands, source, folder))
        examine(("ingest", id, "corrections"), partial(_look_at_receiver, source))
        examine(("ingest", id, "date"), partial(_look_at_date, source.date))
        for key in ("position_ecef_m", "position_llh_deg"):
            if getattr(source, key) is not None:
                examine(("ingest", id, key), partial(_look_at_position, source.source))
    for name, preset in deployment.preset.items():
        for url in preset.sources:
            examine(("preset", name, "sources"), partial(_look_at_source, url, simulations))
        examine(("preset", name, "antenna"), partial(_look_at_antenna, preset.antenna, None))
    for id, solver in deployment.solver.items():  # noqa: A001
        antex, before = file.parent / deployment.deployment.config_folder / solver.antex if solver.antex else None, len(errors)
        examine(("solver", id, "antex"), partial(_look_at_antenna, "", antex))
        for key, name in (("rover_antenna", solver.rover_antenna), ("base_antenna", solver.base_antenna)):
            if len(errors) == before:  # names may be of that file
                examine(("solver", id, key), partial(_look_at_antenna, name, antex))
    for id, output in deployment.output.items():  # noqa: A001
        examine(("output", id, "target"), partial(check_output, output))
    return sorted(errors, key=lambda error: error.line or 0)


def _look_at_source(url: str, simulations: bool) -> None:
    from rtkmesh_services.ingest.urls import parse_source

    source = parse_source(url)
    _ = source.speed
    if source.scheme == "file" and not Path(source.path).is_file():
        raise SourceError(f"{source.path!r}: no such file")
    if source.word("times") == "yes" and not any(Path(source.path + ending).is_file() for ending in (".tag", ".times")):
        raise SourceError(f"{source.path!r}: times=yes, but there is neither a .tag nor a .times beside it")
    if source.scheme == "sim" and simulations:
        _look_at_simulation(source)
    if (authority := source.options.get("ca")) and not Path(authority).is_file():
        raise SourceError(f"ca={authority!r}: no such file")


def _look_at_fallback(first: str, url: str, index: int) -> None:
    from rtkmesh_services.ingest.urls import parse_source

    source = parse_source(url)
    if any(scheme in ("file", "stdin") for scheme in (source.scheme, first.partition("://")[0])):
        raise SourceError(f"[{index}]: a recording neither has a fallback nor is one")
    _look_at_source(url, simulations=False)


def _look_at_position(url: str) -> None:
    from rtkmesh_services.ingest.urls import parse_source, wants_nearest

    try:
        nearest = wants_nearest(parse_source(url))
    except SourceError:
        return  # told where the URL stands
    if nearest:
        raise SourceError("is of one antenna, and ?nearest chooses among many")


def _look_at_commands(table: IngestTable, folder: Path) -> None:
    if table.commands != CommandsTable():
        from rtkmesh_services.ingest.commands import commands_of

        commands_of(table, folder)


def _look_at_receiver(table: IngestTable) -> None:
    """Corrections and orders go to a receiver: there must be one behind the source."""
    from rtkmesh_services.ingest.commands import LISTENING

    scheme = table.source.partition("://")[0]
    if table.corrections is not None and scheme not in LISTENING:
        raise SourceError(f"corrections go to a receiver: the source must be one of {', '.join(LISTENING)}")
    station = table.base_station
    if station is not None and station.mode in ("survey-in", "preset") and scheme not in LISTENING:
        raise SourceError(f"[base_station] mode {station.mode!r} talks to a receiver: the source must be one of {', '.join(LISTENING)}")


def _look_at_simulation(source: "SourceUrl") -> None:
    from rtkmesh.errors import OptionError
    from rtkmesh.gnss.time import GpsTime
    from rtkmesh_services.ingest.replay import open_simulation

    try:
        open_simulation(source, GpsTime(2300, 0.0))
    except OptionError as error:
        raise SourceError(f"{source.path}: {error}") from None


def _look_at_date(text: str) -> None:
    try:
        _ = text and date.fromisoformat(text)
    except ValueError:
        raise SourceError(f"{text!r} is no day YYYY-MM-DD") from None


def _look_at_antenna(name: str, antex: Path | None) -> None:
    if not name and antex is None:
        return
    from rtkmesh.errors import OptionError
    from rtkmesh_services.mapping.antennas import antenna_finder

    try:
        find = antenna_finder(antex)
    except OptionError as error:
        raise SourceError(str(error)) from None
    if name and isinstance(found := find(name, ""), str):
        raise SourceError(found)


def _processes(deployment: Deployment | None) -> list[dict[str, Any]]:
    if deployment is None:
        return []
    rows = [{"role": "hub", "id": "hub"}] if deployment.hub.enabled else []
    rows += [{"role": "control", "id": "control"}] if deployment.control.enabled else []
    for role in ("ingest", "solver", "attitude", "output", "recorder", "ros2", "monitor"):
        rows += [{"role": role, "id": id} for id in getattr(deployment, role)]  # noqa: A001  the word of the design
    return rows


app = command_page(
    check,
    """
    rtkmesh check config/demo.toml
    rtkmesh check robot.toml --json
    rtkmesh check rtkrcv.conf
    """,
)
