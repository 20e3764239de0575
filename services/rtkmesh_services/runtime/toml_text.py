"""Tables as TOML text: plain values first, then the tables below. Of the deployment file's tables what differs from the defaults."""

import json
import re
from collections.abc import Iterator, Mapping
from typing import Any, Final

import msgspec

_BARE: Final = re.compile(r"[A-Za-z0-9_-]+")


def toml_text(tables: Mapping[str, Any]) -> str:
    """Return the TOML text of nested tables."""
    return "\n".join(_nested(tables, ())).strip("\n") + "\n"


def toml_table(name: str, table: msgspec.Struct) -> str:
    """Return a table, with its tables below it, as a TOML text that reads back as the same struct."""
    return "\n\n".join(_tables(name, table)) + "\n"


def toml_value(value: Any) -> str:
    """Return a plain value (text, number, truth value, list of such) in TOML; TypeError for another, ValueError for no Unicode."""
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(toml_value(item) for item in value)}]"  # pyright: ignore[reportUnknownVariableType]  plain values
    if not isinstance(value, (bool, str, int, float)):
        raise TypeError(f"{type(value).__name__} is no value of an option")
    if isinstance(value, (bool, str)):
        text = json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
        return text.encode().decode()
    return repr(value)


def _nested(table: Mapping[str, Any], path: tuple[str, ...]) -> list[str]:
    plain = {name: value for name, value in table.items() if not _is_table(value)}
    lines = ["", f"[{'.'.join(map(_key, path))}]"] if path and (plain or not table) else []
    lines += [f"{_key(name)} = {toml_value(value)}" for name, value in plain.items()]
    for name, value in table.items():
        if _is_table(value):
            lines += _nested(value, (*path, name))
    return lines


def _is_table(value: Any) -> bool:
    return isinstance(value, Mapping)


def _key(name: str) -> str:
    return name if _BARE.fullmatch(name) else json.dumps(name)


def _tables(name: str, table: msgspec.Struct) -> Iterator[str]:
    plain, below = [f"[{name}]"], list[tuple[str, msgspec.Struct]]()
    for field in msgspec.structs.fields(table):
        value, default = getattr(table, field.name), _default(field)
        if isinstance(value, msgspec.Struct):
            below += [(f"{name}.{field.encode_name}", value)] if value != default else []
        elif value != default:
            plain.append(f"{field.encode_name} = {toml_value(value)}")
    yield "\n".join(plain)
    for path, inner in below:
        yield from _tables(path, inner)


def _default(field: msgspec.structs.FieldInfo) -> Any:
    return field.default_factory() if field.default_factory is not msgspec.NODEFAULT else field.default
