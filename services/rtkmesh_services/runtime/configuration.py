"""Reading the deployment file: TOML -> frozen structs, with every fault named by file, line, table, key and nearest name.

``${NAME}`` in a string is an environment variable (secrets belong there), ``{data}`` the folder of the recordings.
"""

import difflib
import hashlib
import math
import os
import re
import stat
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeGuard, TypeVar

import msgspec

from rtkmesh.errors import OptionError
from rtkmesh.gnss.receiver_options import parse_receiver_options
from rtkmesh_schemas.config import Deployment, IngestTable, OutputTable, SolverTable
from rtkmesh_schemas.errors import BadKeyError, ConfigError
from rtkmesh_schemas.keys import CONTROL_ID, Role, check_id
from rtkmesh_services.runtime.toml_lines import lines_of

HUB_ID: Final = "hub"
MAXIMUM_SOLVER_FILE: Final = 65536
MAXIMUM_FILE: Final = 1 << 20
DATA_VARIABLE: Final = "RTKMESH_DATA"
_REFERENCE: Final = re.compile(r"\$\{([A-Za-z_][A-Za-z0-9_]*)\}")
_UNKNOWN: Final = re.compile(r"unknown field `(?P<name>.*?)`")
_MISSING: Final = re.compile(r"missing required field `(?P<name>.*?)`")
_AT: Final = re.compile(r" - at `\$(?P<path>.*?)`$")
_SATELLITE: Final = re.compile(r"[GRECJSI]\d\d")
_MOUNT: Final = re.compile(r"[A-Za-z0-9_.-]{1,100}")
_FILE_NAME: Final = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,99}")
_LOOPBACK: Final = re.compile(r"(?:tcp|udp|quic|tls|ws)/(?:127\.\d+\.\d+\.\d+|localhost|\[::1\]):\d+|unixsock-stream/.+")
_MULTIPLE: Final = ("ingest", "solver", "attitude", "output", "recorder", "ros2", "monitor")

T = TypeVar("T", bound=msgspec.Struct)


@dataclass(frozen=True, kw_only=True)
class Site:
    """A loaded deployment file and what belongs to it. ``folder``: the only one that ``load`` reads from."""

    deployment: Deployment
    file: Path
    folder: Path
    hash: str
    data_folder: Path | None


class ConfigErrors(ConfigError):  # noqa: N818  several of them
    """All faults of a file: a ConfigError (the first) whose text has every one, a line each."""

    def __init__(self, errors: list[ConfigError]) -> None:
        super().__init__(errors[0].file, errors[0].line, errors[0].message)
        self.errors = errors

    def __str__(self) -> str:
        return "\n".join(str(error) for error in self.errors)


def load_deployment(path: Path | str, data_folder: Path | None = None, speed: str = "") -> Deployment:
    """Return the deployment in a file; ConfigErrors names everything that is wrong in it."""
    return load_site(path, data_folder, speed).deployment


def load_site(path: Path | str, data_folder: Path | None = None, speed: str = "") -> Site:
    """Return the deployment in a file with its folders and hash; ConfigErrors names everything that is wrong in it.

    ``speed`` (1, 10, max) replaces the speed of all recordings.
    """
    path = Path(path)
    text = _text_of(path, MAXIMUM_FILE)
    data_folder = find_data_folder(data_folder)
    deployment = with_speed(parse_deployment(text, str(path), data_folder), speed)
    folder = path.parent / deployment.deployment.config_folder
    return Site(
        deployment=deployment,
        file=path.resolve(),
        folder=folder.resolve(),
        hash=hashlib.sha256(text.encode()).hexdigest()[:12],
        data_folder=data_folder,
    )


def with_speed(deployment: Deployment, speed: str) -> Deployment:
    """Return the deployment with all recordings at another speed; ConfigError for a speed that is none."""
    if not speed:
        return deployment
    if not re.fullmatch(r"max|(?=.*[1-9])\d{0,6}(?:\.\d{0,6})?", speed):
        raise ConfigError("--speed", None, f"{clip(speed)!r} is no speed: 1 is real time, 10 ten times as fast, max as fast as it goes")
    tables = {
        name: msgspec.structs.replace(table, source=_source_with(table.source, speed)) if table.source.startswith("file:") else table
        for name, table in deployment.ingest.items()
    }
    return msgspec.structs.replace(deployment, ingest=tables)


def _source_with(source: str, speed: str) -> str:
    where, _, query = source.partition("?")
    options = [option for option in query.split("&") if option and not option.startswith("speed=")]
    return f"{where}?{'&'.join([*options, f'speed={speed}'])}"


def find_data_folder(given: Path | None = None) -> Path | None:
    """Return the folder of the recordings: the one given, RTKMESH_DATA, or ../shared/data beside a checkout; None without.

    ConfigError when the one given is none.
    """
    if given is not None and not given.is_dir():
        raise ConfigError("--data", None, f"{given} is no folder")
    for candidate in (given, os.environ.get(DATA_VARIABLE), Path(__file__).resolve().parents[4] / "shared" / "data"):
        if candidate and Path(candidate).is_dir():
            return Path(candidate).resolve()
    return None


def parse_deployment(text: str, file: str, data_folder: Path | None = None) -> Deployment:
    """Return the deployment in a TOML text; ConfigErrors names everything that is wrong in it."""
    reader = _Reader(file, text, data_folder)
    deployment = reader.deployment()
    _check(reader, deployment)
    reader.finish()
    return deployment


def load_solver_table(name: str, config_folder: Path) -> SolverTable:
    """Return the one ``[solver]`` table of a TOML file below the configured folder; ConfigError for anything else.

    ``name`` is a file's name or a relative path of plain names: no way out, no link, a regular file of at most 64 KiB.
    """
    text = _read_below(name, config_folder)
    reader = _Reader(name, text, None)
    for key in reader.raw:
        if key != "solver":
            reader.fault((key,), f"unknown table [{key}]: a solver file has one table, [solver]")
    if "solver" not in reader.raw:
        reader.fault((), "no table [solver]")
        reader.finish()
    table = reader.table(SolverTable, reader.raw["solver"], ("solver",))
    reader.finish()
    assert table is not None  # finish raises when there was a fault
    return table


def nearest(name: str, among: Iterator[str] | list[str]) -> str:
    """Return `; did you mean 'x'?` or nothing."""
    names = list(among)
    found = difflib.get_close_matches(name, names, 1, 0.5)
    parts = [known for known in names if len(name) >= 3 and (name in known.split("_") or known.startswith(name))]
    best = (parts or found)[:1]
    return f"; did you mean {best[0]!r}?" if best else ""


class _Reader:
    """One TOML text on its way into structs; faults are gathered, ``finish`` raises them."""

    def __init__(self, file: str, text: str, data_folder: Path | None) -> None:
        self.file, self.data_folder = file, data_folder
        self.errors: list[ConfigError] = []
        try:
            self.raw: dict[str, Any] = tomllib.loads(text)
        except (tomllib.TOMLDecodeError, RecursionError) as error:
            raise ConfigErrors([_syntax_error(file, error)]) from error
        self._lines = lines_of(text)
        self.raw = self._expanded(self.raw, ())

    def fault(self, path: tuple[str, ...], message: str) -> None:
        """Gather one fault at a key (or at the nearest table above it)."""
        line: int | None = None
        for length in range(len(path), 0, -1):
            if (line := self._lines.get(path[:length])) is not None:
                break
        self.errors.append(ConfigError(self.file, line, message))

    def finish(self) -> None:
        """Raise what was gathered, in the order of lines."""
        if self.errors:
            raise ConfigErrors(sorted(self.errors, key=lambda error: error.line or 0))

    def deployment(self) -> Deployment:
        """Return the deployment of all tables that are right."""
        values: dict[str, Any] = {}
        fields = {field.name: field for field in msgspec.structs.fields(Deployment)}
        for name, table in self.raw.items():
            if name not in fields:
                self.fault((name,), f"unknown table [{name}]{nearest(name, list(fields))}")
            elif not _is_table(table):
                self.fault((name,), f"[{name}] is a table, not {type(table).__name__}")
            elif name in _MULTIPLE:
                kind = fields[name].type.__args__[1]
                values[name] = {id: made for id, row in table.items() if (made := self.table(kind, row, (name, id))) is not None}  # noqa: A001
            elif (made := self.table(fields[name].type, table, (name,))) is not None:
                values[name] = made
        return Deployment(**values)

    def table(self, kind: type[T], table: Any, path: tuple[str, ...]) -> T | None:
        """Return the struct in a table, or None: each fault is gathered, the table tried again without it."""
        if not _is_table(table):
            self.fault(path, f"[{'.'.join(path[:-1])}] has tables of its own: write [{'.'.join(path)}] with its keys below")
            return None
        rest, first = _copied(table), len(self.errors)
        while True:
            try:
                made = msgspec.convert(rest, kind, strict=True)
            except msgspec.ValidationError as error:
                inner, at = _location(str(error))
                missing = _MISSING.search(str(error))
                if missing is None or len(self.errors) == first:
                    self._explain(kind, str(error), inner, (*path, *at), missing)
                if missing is not None or not _removed(rest, at, inner):
                    return None
            else:
                return made if len(self.errors) == first else None

    def _explain(
        self, kind: type[msgspec.Struct], text: str, inner: str | None, path: tuple[str, ...], missing: re.Match[str] | None
    ) -> None:
        message = _AT.sub("", text)
        table = path[: _depth(kind, path)]
        if missing is not None:
            self.fault(path, f"[{'.'.join(path)}] has no {missing['name']!r}, which it needs")
        elif inner is not None:
            known = [field.encode_name for field in msgspec.structs.fields(_kind_at(kind, path[len(table) :]))]
            self.fault(
                (*path, inner), f"[{'.'.join(path)}] unknown key {inner!r}{nearest(inner, known) or f'; known are {_listed(known)}'}"
            )
        else:
            self.fault(path, f"{_named(path)}: {_plain(message)}{self._allowed(kind, path, table)}")

    def _allowed(self, kind: type[msgspec.Struct], path: tuple[str, ...], table: tuple[str, ...]) -> str:
        """Return the allowed values of an enumeration, with the nearest, or nothing."""
        kind = _kind_at(kind, path[len(table) : -1])
        annotation = next((field.type for field in msgspec.structs.fields(kind) if field.encode_name == path[-1]), None)
        allowed = [str(value) for value in _literals(annotation)]
        if not allowed:
            return ""
        given = _at(self.raw, path)
        return f"; allowed are {_listed(allowed)}{nearest(str(given), allowed)}"

    def _expanded(self, value: Any, path: tuple[str, ...]) -> Any:
        """Return the raw value with the references in its strings replaced; NaN and infinity are faults."""
        if isinstance(value, str):
            return self._expanded_text(value, path)
        if isinstance(value, float) and not math.isfinite(value):
            self.fault(path, f"{_named(path)}: {value} is no number here")
            return msgspec.UNSET
        if isinstance(value, dict):
            items = {key: self._expanded(item, (*path, str(key))) for key, item in value.items()}  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]  any TOML
            return {name: item for name, item in items.items() if item is not msgspec.UNSET}  # pyright: ignore[reportUnknownVariableType]  as above
        if isinstance(value, list):
            items = [self._expanded(item, (*path, str(index))) for index, item in enumerate(value)]  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]  any TOML
            return [item for item in items if item is not msgspec.UNSET]
        return value

    def _expanded_text(self, text: str, path: tuple[str, ...]) -> str:
        def value_of(match: re.Match[str]) -> str:
            value = os.environ.get(match[1])
            if value is None:
                self.fault(path, f"{_named(path)}: the environment has no {match[1]}")
            return value or ""

        text = _REFERENCE.sub(value_of, text)
        if "{data}" in text:
            if self.data_folder is None:
                self.fault(path, f"{_named(path)}: no folder of recordings: say --data DIR or {DATA_VARIABLE}")
            text = text.replace("{data}", str(self.data_folder))
        return text


def _check(reader: _Reader, deployment: Deployment) -> None:
    """Gather the faults between tables: ids, references, where the hub listens."""
    owners: dict[str, str] = {HUB_ID: "hub", CONTROL_ID: "control"}
    for role in _MULTIPLE:
        for id in getattr(deployment, role):  # noqa: A001  the word of the design
            _check_id(reader, owners, role, id)
    for id, ingest in deployment.ingest.items():  # noqa: A001
        _check_options(reader, id, ingest.options)
        _check_ingest(reader, id, ingest)
    for id, solver in deployment.solver.items():  # noqa: A001
        _check_reference(reader, "ingest", solver.rover, ("solver", id, "rover"))
        if solver.base:
            _check_reference(reader, "ingest", solver.base, ("solver", id, "base"))
        elif solver.mode != "single":
            reader.fault(("solver", id), f"[solver.{id}] has no 'base', which mode {solver.mode!r} needs")
        for index, navigation in enumerate(solver.navigation):
            _check_reference(reader, "ingest", navigation, ("solver", id, "navigation", str(index)))
        _check_solver(reader, id, solver)
    for id, table in deployment.attitude.items():  # noqa: A001
        _check_reference(reader, "solver", table.solver, ("attitude", id, "solver"))
    for id in deployment.ingest:  # noqa: A001
        _check_followed(reader, id, deployment.ingest)
    for id, output in deployment.output.items():  # noqa: A001
        _check_output(reader, id, output)
    _check_lists(reader, deployment)
    for index, address in enumerate(deployment.hub.listen):
        if not deployment.hub.insecure and not _LOOPBACK.fullmatch(address):
            reader.fault(
                ("hub", "listen", str(index)),
                f"[hub] listen: {address!r} is no loopback address; others could command your receivers: say insecure = true to allow it",
            )


def _check_options(reader: _Reader, id: str, text: str) -> None:  # noqa: A002
    try:
        parse_receiver_options(text)
    except OptionError as error:
        reader.fault(("ingest", id, "options"), f"[ingest.{id}] options: {error}")


def _check_ingest(reader: _Reader, id: str, table: IngestTable) -> None:  # noqa: A002
    for index, base in enumerate(table.corrections.bases if table.corrections else ()):
        path = ("ingest", id, "corrections", "from", str(index))
        if base == id:
            reader.fault(path, f"[ingest.{id}.corrections] from: a receiver does not correct itself")
        else:
            _check_reference(reader, "ingest", base, path)
    if table.corrections is not None and not table.corrections.bases:
        reader.fault(("ingest", id, "corrections", "from"), f"[ingest.{id}.corrections] from: names no base")
    station = table.base_station
    if station is None:
        return
    positions = [name for name in ("position_ecef_m", "position_llh_deg") if getattr(station, name) is not None]
    where = ("ingest", id, "base_station")
    if station.mode == "fixed" and len(positions) != 1:
        reader.fault(where, f"[ingest.{id}.base_station] mode 'fixed' needs either 'position_ecef_m' or 'position_llh_deg'")
    elif station.mode != "fixed" and positions:
        reader.fault((*where, positions[0]), f"[ingest.{id}.base_station] {positions[0]} is of mode 'fixed', not of {station.mode!r}")
    if station.mode == "preset" and not station.preset:
        reader.fault(where, f"[ingest.{id}.base_station] mode 'preset' needs 'preset', the name of a saved position")
    if station.mode in ("survey-in", "preset") and station.receiver == "other":
        text = f"mode {station.mode!r} needs 'receiver', whose language we speak: ublox, ublox-legacy, unicore, septentrio"
        reader.fault(where, f"[ingest.{id}.base_station] {text}; for other receivers there is mode 'average'")
    if table.position_ecef_m is not None or table.position_llh_deg is not None:
        reader.fault(where, f"[ingest.{id}.base_station] and a position of [ingest.{id}] itself: say it once, here")


def _check_solver(reader: _Reader, id: str, solver: SolverTable) -> None:  # noqa: A002
    if solver.mode == "fixed" and solver.fixed_position_ecef_m is None:
        reader.fault(("solver", id, "mode"), f"[solver.{id}] mode 'fixed' needs 'fixed_position_ecef_m', where the rover is")
    for index, name in enumerate(solver.excluded):
        if not _SATELLITE.fullmatch(name):
            reader.fault(("solver", id, "excluded", str(index)), f"[solver.{id}] excluded: {clip(name)!r} is no satellite such as G05")


def _check_output(reader: _Reader, id: str, output: OutputTable) -> None:  # noqa: A002
    given = [name for name in ("solver", "receiver", "mounts") if getattr(output, name)]
    wanted = "mounts" if output.target.startswith("ntrip-caster://") else "solver or receiver"
    if len(given) != 1 or (given[0] == "mounts") != (wanted == "mounts"):
        has = f"has {' and '.join(repr(name) for name in given)}" if given else "says nothing"
        reader.fault(("output", id), f"[output.{id}] {has} where it needs {wanted}: what is to be sent")
        return
    if output.encode and (output.solver or output.protocol != "rtcm3"):
        what = "a solver's lines" if output.solver else f'protocol = "{output.protocol}"'
        reader.fault(("output", id, "encode"), f"[output.{id}] encode makes RTCM 3 of a receiver's stream, and this is {what}")
    if output.solver:
        _check_reference(reader, "solver", output.solver, ("output", id, "solver"))
    if output.receiver:
        _check_reference(reader, "ingest", output.receiver, ("output", id, "receiver"))
    for mount, receiver in output.mounts.items():
        if not _MOUNT.fullmatch(mount):
            text = f"{clip(mount)!r} is no mount point: letters, digits, '_', '-', '.'"
            reader.fault(("output", id, "mounts", mount), f"[output.{id}] mounts: {text}")
        _check_reference(reader, "ingest", receiver, ("output", id, "mounts", mount))


def _check_followed(reader: _Reader, id: str, ingests: Mapping[str, IngestTable]) -> None:  # noqa: A002
    """An ingest that takes another one's frames needs one that publishes them, live."""
    for followed in ingests[id].follows:
        path, table = ("ingest", id, "source"), ingests.get(followed)
        if table is None:
            _check_reference(reader, "ingest", followed, path)
            continue
        reason = "publishes no frames: raw = false" if not table.raw else ""
        reason = "takes its frames from an ingest itself" if table.follows else reason
        reason = "is a recording: play it twice, the second time with ?antenna=2" if table.replay else reason
        if reason:
            reader.fault(path, f"[ingest.{id}] source: [ingest.{followed}] {reason}")


def _check_id(reader: _Reader, owners: dict[str, str], role: str, id: str) -> None:  # noqa: A002
    try:
        check_id(id)
    except BadKeyError as error:
        reader.fault((role, id), f"[{role}.{id}] {error}")
    if id == "*":
        reader.fault((role, id), f"[{role}.{id}] '*' is no id")
    if id in owners:
        reader.fault((role, id), f"[{role}.{id}] the id {id!r} is taken by {owners[id]}: ids are unique over all roles")
    owners[id] = f"[{role}.{id}]"


def _check_lists(reader: _Reader, deployment: Deployment) -> None:
    for id, table in deployment.recorder.items():  # noqa: A001
        for index, receiver in enumerate(table.receivers):
            _check_reference(reader, "ingest", receiver, ("recorder", id, "receivers", str(index)))
    for id, table in deployment.ros2.items():  # noqa: A001
        for index, solver in enumerate(table.solvers):
            _check_reference(reader, "solver", solver, ("ros2", id, "solvers", str(index)))
        for index, attitude in enumerate(table.attitudes):
            _check_reference(reader, "attitude", attitude, ("ros2", id, "attitudes", str(index)))


def _check_reference(reader: _Reader, role: str, id: str, path: tuple[str, ...]) -> None:  # noqa: A002
    tables = reader.raw.get(role)  # also those that have faults of their own
    known: Mapping[str, Any] = tables if _is_table(tables) else {}
    if id not in known:
        there = nearest(id, list(known)) or f"; there {'are' if len(known) != 1 else 'is'} {_listed(list(known)) or 'none'}"
        reader.fault(path, f"[{path[0]}.{path[1]}] {path[2]}: no [{role}.{id}]{there}")


def require_id(site: Site, role: Role, id: str) -> None:  # noqa: A002
    """ConfigError unless the deployment has a process of that role and id."""
    if role in {Role.HUB, Role.CONTROL}:
        return
    known: Mapping[str, Any] = getattr(site.deployment, role.value)
    if id not in known:
        raise ConfigError(str(site.file), None, f"no [{role}.{id}]{nearest(id, list(known))}")


def _text_of(path: Path, limit: int) -> str:
    try:
        data = path.read_bytes() if path.stat().st_size <= limit else None
    except OSError as error:
        raise ConfigErrors([ConfigError(str(path), None, error.strerror or str(error))]) from error
    if data is None:
        raise ConfigErrors([ConfigError(str(path), None, f"more than {limit} bytes")])
    return _decoded(data, str(path))


def _decoded(data: bytes, file: str) -> str:
    try:
        return data.decode()
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ConfigErrors([ConfigError(file, line, "no UTF-8 text")]) from error


def _read_below(name: str, folder: Path) -> str:
    """Return the text of a file below ``folder``, opened step by step without following links."""
    parts = name.split("/")
    if not name or any(not _FILE_NAME.fullmatch(part) for part in parts):
        raise ConfigError(clip(name), None, "no file's name: letters, digits, '.', '_', '-', below the configuration folder")
    descriptors: list[int] = []
    try:
        descriptors.append(os.open(folder, os.O_RDONLY | os.O_DIRECTORY))
        for part in parts[:-1]:
            descriptors.append(os.open(part, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW, dir_fd=descriptors[-1]))
        descriptors.append(os.open(parts[-1], os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK, dir_fd=descriptors[-1]))
        if not stat.S_ISREG(os.fstat(descriptors[-1]).st_mode):
            raise ConfigError(name, None, "no regular file")
        data = os.read(descriptors[-1], MAXIMUM_SOLVER_FILE + 1)
    except OSError as error:
        raise ConfigError(name, None, f"{error.strerror or error} (below the configuration folder)") from error
    finally:
        for descriptor in descriptors:
            os.close(descriptor)
    if len(data) > MAXIMUM_SOLVER_FILE:
        raise ConfigError(name, None, f"more than {MAXIMUM_SOLVER_FILE} bytes")
    return _decoded(data, name)


def clip(text: str) -> str:
    """Return foreign text short and printable, for an error."""
    return "".join(character if character.isprintable() else "�" for character in text[:100])


def _syntax_error(file: str, error: Exception) -> ConfigError:
    match = re.search(r" \(at line (\d+), column (\d+)\)$", str(error))
    if match is None:
        return ConfigError(file, None, f"no TOML: {error}")
    return ConfigError(file, int(match[1]), f"no TOML: {str(error)[: match.start()]} (column {match[2]})")


def _location(text: str) -> tuple[str | None, tuple[str, ...]]:
    """Return (the unknown key or None, the path) of a message of msgspec."""
    match, unknown = _AT.search(text), _UNKNOWN.search(text)
    chunks = re.findall(r"\.([A-Za-z0-9_]+)|\[(\d+|\.\.\.)\]", match["path"]) if match else []
    return (unknown["name"] if unknown else None), tuple(name or index for name, index in chunks)


def _removed(table: dict[str, Any], path: tuple[str, ...], inner: str | None) -> bool:
    """Take the faulty key out of the table; False when there is none."""
    names = [*path, inner] if inner is not None else list(path)
    for name in names[:-1]:
        below = table.get(name)
        if not _is_table(below):  # an element of an array: the whole array goes
            names[-1] = name
            break
        table = below
    return bool(names) and table.pop(names[-1], None) is not None


def _named(path: tuple[str, ...]) -> str:
    """Return ``[table] key`` or ``[table] key[index]`` for a path."""
    names = list(path)
    index = ""
    while len(names) > 1 and names[-1].isdecimal():
        index = f"[{names.pop()}]{index}"
    return f"[{'.'.join(names[:-1])}] {names[-1]}{index}"


def _depth(kind: type[msgspec.Struct], path: tuple[str, ...]) -> int:
    """Return how many chunks of the path name the table of ``kind`` itself: 2 for [solver.rtk], 1 for [hub]."""
    return 2 if path[0] in _MULTIPLE and not (kind is SolverTable and path[1:2] and path[1] in SolverTable.__struct_fields__) else 1


def _kind_at(kind: type[msgspec.Struct], path: tuple[str, ...]) -> type[msgspec.Struct]:
    for name in path:
        annotation = next((field.type for field in msgspec.structs.fields(kind) if field.encode_name == name), None)
        for part in (annotation, *getattr(annotation, "__args__", ())):  # a table that may be left out is a union with None
            if isinstance(part, type) and issubclass(part, msgspec.Struct):
                kind = part
    return kind


def _literals(annotation: Any) -> list[Any]:
    """Return the values of a Literal, also inside a union."""
    if getattr(annotation, "__origin__", None) is not None and str(annotation).startswith("typing.Literal"):
        return list(annotation.__args__)
    return [value for part in getattr(annotation, "__args__", ()) for value in _literals(part)]


def _plain(message: str) -> str:
    names = {"`str`": "text", "`float`": "a number", "`int`": "a whole number", "`bool`": "true or false", "`array`": "a list"}
    for word, plain in names.items():
        message = message.replace(word, plain)
    return (message[0].lower() + message[1:]).replace("`", "")


def _listed(names: list[str]) -> str:
    return ", ".join(names)


def _is_table(value: Any) -> TypeGuard[dict[str, Any]]:
    return isinstance(value, dict)


def _copied(table: dict[str, Any]) -> dict[str, Any]:
    return {name: _copied(value) if _is_table(value) else value for name, value in table.items()}


def _at(value: Any, path: tuple[str, ...]) -> Any:
    for name in path:
        value = value.get(name) if _is_table(value) else None
    return value
