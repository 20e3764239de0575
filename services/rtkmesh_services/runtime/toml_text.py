"""Tables of the deployment file back to TOML: what differs from the defaults, in the order of the fields."""

import json
from collections.abc import Iterator
from typing import Any

import msgspec


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
