"""What a command may hold: plain values of bounded depth, number and size, whatever its encoding allows."""

import math
from typing import Any, Final

from rtkmesh_schemas.command import Request

MAXIMUM_DEPTH: Final = 8  # of lists and tables in each other
MAXIMUM_VALUES: Final = 1000  # in all arguments together
MAXIMUM_NAME: Final = 64  # characters of an operation's or argument's name
MAXIMUM_LABEL: Final = 256  # characters of request_id, caller and start_id
_LARGEST: Final = 1 << 63


def fault_of(request: Request) -> str:
    """Return what a command may not hold, or nothing."""
    if not request.op.strip() or len(request.op) > MAXIMUM_NAME:
        return f"op is a word of 1 to {MAXIMUM_NAME} characters"
    for name in ("request_id", "caller", "start_id"):
        if len(getattr(request, name)) > MAXIMUM_LABEL:
            return f"{name} has more than {MAXIMUM_LABEL} characters"
    return _fault_of_values(request.args)


def _fault_of_values(args: dict[str, Any]) -> str:
    """Look at all values, without recursion: what is nested too deep is not followed."""
    waiting: list[tuple[Any, int]] = [(args, 1)]
    seen = 0
    while waiting:
        value, depth = waiting.pop()
        seen += 1
        if seen > MAXIMUM_VALUES:
            return f"more than {MAXIMUM_VALUES} values in the arguments"
        if fault := _fault_of_one(value, depth):
            return fault
        inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()  # pyright: ignore[reportUnknownVariableType, reportUnknownMemberType]  any plain value
        waiting += [(item, depth + 1) for item in inner]  # pyright: ignore[reportUnknownVariableType]  as above
    return ""


def _fault_of_one(value: Any, depth: int) -> str:
    if isinstance(value, (dict, list)):
        if depth > MAXIMUM_DEPTH:
            return f"arguments nested more than {MAXIMUM_DEPTH} deep"
        return _fault_of_names(value) if isinstance(value, dict) else ""  # pyright: ignore[reportUnknownArgumentType]  any keys
    if isinstance(value, float):
        return "" if math.isfinite(value) else f"{value} is no number"
    if isinstance(value, int):
        return "" if -_LARGEST <= value < _LARGEST else "a whole number of more than 64 bits"
    return "" if value is None or isinstance(value, str) else f"a {type(value).__name__} is no plain value"


def _fault_of_names(table: dict[Any, Any]) -> str:
    for name in table:
        if not isinstance(name, str):
            return "a name of an argument that is no text"
        if not 0 < len(name) <= MAXIMUM_NAME or not name.isprintable():
            return f"names of arguments have 1 to {MAXIMUM_NAME} printable characters"
    return ""
