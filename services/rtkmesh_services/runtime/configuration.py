"""Reading the deployment file: TOML -> frozen structs, with every fault named by file, line, table, key and nearest name.

``${NAME}`` in a string is an environment variable (secrets belong there), ``{data}`` the folder of the recordings.
"""

import hashlib
import math
import os
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeGuard, TypeVar

import msgspec

from rtkmesh_schemas.config import Deployment, SolverTable
from rtkmesh_schemas.errors import ConfigError
from rtkmesh_schemas.keys import Role
from rtkmesh_services.runtime.deployment_checks import NAMED, check_deployment
from rtkmesh_services.runtime.files_below import read_below
from rtkmesh_services.runtime.toml_lines import lines_of
from rtkmesh_services.runtime.words import clip, nearest

MAXIMUM_SOLVER_FILE: Final = 65536
MAXIMUM_FILE: Final = 1 << 20
DATA_VARIABLE: Final = "RTKMESH_DATA"
_REFERENCE: Final = re.compile(r"\$\{([A-Za-z_][A-Za-z0-9_]*)\}")
_UNKNOWN: Final = re.compile(r"unknown field `(?P<name>.*?)`")
_MISSING: Final = re.compile(r"missing required field `(?P<name>.*?)`")
_AT: Final = re.compile(r" - at `\$(?P<path>.*?)`$")

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
    check_deployment(reader, deployment)
    reader.finish()
    return deployment


def load_solver_table(name: str, config_folder: Path) -> SolverTable:
    """Return the one ``[solver]`` table of a TOML file below the configured folder; ConfigError for anything else.

    ``name`` is a file's name or a relative path of plain names: no way out, no link, a regular file of at most 64 KiB.
    """
    return parse_solver_table(_decoded(read_below(name, config_folder, MAXIMUM_SOLVER_FILE), name), name)


def parse_solver_table(text: str, name: str) -> SolverTable:
    """Return the one ``[solver]`` table of a TOML text; ConfigErrors names everything that is wrong in it."""
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


class _Reader:
    """One TOML text on its way into structs; faults are gathered, ``finish`` raises them."""

    def __init__(self, file: str, text: str, data_folder: Path | None) -> None:
        self.file, self.data_folder = file, data_folder
        self.errors: list[ConfigError] = []
        try:
            self.raw: dict[str, Any] = tomllib.loads(text)
        except (tomllib.TOMLDecodeError, RecursionError) as error:
            raise ConfigErrors([_syntax_error(file, text, error)]) from error
        self._lines = lines_of(text)
        self.raw = self._expanded(self.raw, ())

    def fault(self, path: tuple[str, ...], message: str) -> None:
        """Gather one fault at a key (or at the nearest table above it)."""
        line: int | None = None
        for length in range(len(path), 0, -1):
            if (line := self._lines.get(path[:length])) is not None:
                break
        self.errors.append(ConfigError(self.file, line, message))

    def names_of(self, role: str) -> list[str]:
        """Return the ids of a role, also of tables that have faults of their own."""
        tables = self.raw.get(role)
        return list(tables) if _is_table(tables) else []

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
            elif name in NAMED:
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


def _syntax_error(file: str, text: str, error: Exception) -> ConfigError:
    match = re.search(r" \(at line (\d+), column (\d+)\)$", str(error))
    if match is None:  # at the end of the document
        return ConfigError(file, text.rstrip().count("\n") + 1, f"no TOML: {error}")
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
    return 2 if path[0] in NAMED and not (kind is SolverTable and path[1:2] and path[1] in SolverTable.__struct_fields__) else 1


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
    message = message.replace(" | null`", "`")
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
