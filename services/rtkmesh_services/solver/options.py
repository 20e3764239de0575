"""The options of a solver by name (``elevation_mask_deg``, ``ambiguity.ratio``): told, changed, and checked as those of a file."""

import json
from collections.abc import Iterator
from typing import Any, Final

import msgspec

from rtkmesh_schemas.command import Code
from rtkmesh_schemas.config import SolverTable
from rtkmesh_schemas.errors import ConfigError
from rtkmesh_services.errors import CommandError
from rtkmesh_services.runtime.configuration import ConfigErrors, parse_solver_table
from rtkmesh_services.runtime.toml_text import toml_value
from rtkmesh_services.runtime.words import clip, nearest

WIRING: Final = ("rover", "base", "navigation")  # streams: they are no options
_WORDS: Final = {"on": True, "off": False, "true": True, "false": False}


def options_of(table: SolverTable) -> dict[str, Any]:
    """Return all options of a table, nested ones as ``table.key``; None: the engine's default."""
    return dict(_flat("", table))


def _flat(head: str, table: msgspec.Struct) -> Iterator[tuple[str, Any]]:
    for field in msgspec.structs.fields(table):
        value, name = getattr(table, field.name), f"{head}{field.encode_name}"
        if isinstance(value, msgspec.Struct):
            yield from _flat(f"{name}.", value)
        elif name not in WIRING:
            yield name, value


def is_option(name: str, table: SolverTable) -> bool:
    """Return whether a name is one of our own options (and not RTKLIB's)."""
    return name in options_of(table)


def with_option(table: SolverTable, name: str, value: Any) -> SolverTable:
    """Return the table with one option changed; CommandError in RTKRCV's words, with the bounds or the nearest right name.

    ``value`` may be text, as a console has it; nothing (or None) is the default.
    """
    known = options_of(table)
    if name in WIRING:
        raise CommandError(Code.BAD_ARGUMENTS, f"option {name} is a stream, not an option: it is set in the deployment file")
    if name not in known:
        raise CommandError(Code.NOT_FOUND, f"no option type: {clip(name)}{nearest(name, list(known))}")
    faults: list[str] = []
    for reading in _readings(value):
        try:
            return _replaced(table, name, _checked(name, reading))
        except ConfigError as error:
            faults.append(_fault(error))
    raise CommandError(Code.BAD_ARGUMENTS, f"invalid option value: {name} {clip(str(value))} ({faults[0]})")


def _readings(value: Any) -> list[Any]:
    """Return what a value may mean: text from a console may be a number, a truth value or a list."""
    if not isinstance(value, str):
        return [value]
    text = value.strip()
    if not text:
        return [None]
    try:
        read = [json.loads(text)]
    except ValueError:
        read = [_WORDS[text.lower()]] if text.lower() in _WORDS else []
    parts = text.replace(",", " ").split()
    return [*read, text, parts, [_number(part) for part in parts]]


def _number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


def _checked(name: str, value: Any) -> Any:
    """Return a value as a file would give it; ConfigError says what is wrong with it."""
    if value is None:
        return None
    try:
        line = f"{name} = {toml_value(value)}"
    except (TypeError, ValueError) as error:
        raise ConfigError(name, None, str(error)) from error
    table = parse_solver_table(f'[solver]\nrover = "rover"\n{line}\n', name)
    return options_of(table)[name]


def _fault(error: ConfigError) -> str:
    first = error.errors[0] if isinstance(error, ConfigErrors) else error
    return first.message.partition(": ")[2] or first.message


def _replaced(table: SolverTable, name: str, value: Any) -> SolverTable:
    head, dot, rest = name.partition(".")
    if not dot:
        return msgspec.structs.replace(table, **{head: _or_default(table, head, value)})
    inner = getattr(table, head)
    return msgspec.structs.replace(table, **{head: msgspec.structs.replace(inner, **{rest: _or_default(inner, rest, value)})})


def _or_default(table: msgspec.Struct, name: str, value: Any) -> Any:
    return next(field.default for field in msgspec.structs.fields(table) if field.name == name) if value is None else value


def shown(value: Any) -> str:
    """Return a value as the word ``option`` shows it."""
    if value is None:
        return ""
    if isinstance(value, (list, tuple)):
        return ",".join(str(item) for item in value)  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]  plain values
    if isinstance(value, bool):
        return "on" if value else "off"
    return f"{value:.10g}" if isinstance(value, float) else str(value)
