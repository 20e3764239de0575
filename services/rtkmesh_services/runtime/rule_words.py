"""The words of rules: conditions on fields of messages, and commands. Values, no clock and no network."""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from operator import eq, ge, gt, le, lt, ne
from typing import Any, Final

import msgspec

from rtkmesh_schemas.config_rules import RuleTable
from rtkmesh_schemas.status import Level
from rtkmesh_services.runtime.console_words import WordError, arguments
from rtkmesh_services.runtime.words import clip, nearest

SILENT: Final = "silent"
WHOLE: Final = "value"
EVENT: Final = "event"
_CONDITION: Final = re.compile(r"\s*([A-Za-z_]\w*(?:\.\w+)*)\s*(>=|<=|==|!=|=|>|<)\s*(.+?)\s*")
_ORDER: Final[Mapping[str, Callable[[Any, Any], bool]]] = {">": gt, ">=": ge, "<": lt, "<=": le}
_EQUAL: Final[Mapping[str, Callable[[Any, Any], bool]]] = {"==": eq, "=": eq, "!=": ne}
_WORDS: Final[Mapping[str, bool]] = {"true": True, "false": False}
_OPERATION: Final = re.compile(r"[a-z][a-z0-9_]*")
_TARGET: Final = re.compile(r"[a-z0-9_*]+|\{id\}")
_KEY: Final = re.compile(r"(?:[^/*$#?{}\s]+|\*|\*\*)(?:/(?:[^/*$#?{}\s]+|\*|\*\*))*")
_MISSING: Final = object()


class RuleError(ValueError):
    """A rule that cannot be understood; ``field`` is the one at fault."""

    def __init__(self, field: str, message: str) -> None:
        super().__init__(message)
        self.field = field


@dataclass(frozen=True, slots=True)
class Condition:
    """``field`` compared with ``value``; ``margin`` is how far it must come back to end. ``silent``: no message at all."""

    field: tuple[str, ...]
    operator: str
    value: float | str | bool
    margin: float = 0.0
    silent: bool = False

    def holds(self, found: Any, *, begun: bool) -> bool | None:
        """Return whether a value meets it; ``begun``: it did before. None for a value that says nothing (NaN, another type)."""
        if compare := _EQUAL.get(self.operator):
            return compare(found, self.value) if type(found) is type(self.value) or _are_numbers(found, self.value) else None
        limit = self.value
        if not _is_number(found) or isinstance(limit, str) or math.isnan(found):
            return None
        margin = self.margin if begun else 0.0
        return _ORDER[self.operator](found, limit - margin if self.operator in {">", ">="} else limit + margin)

    def of(self, message: Any) -> Any:
        """Return the field of a message; None where there is none."""
        found = _inner(message, self.field)
        if found is _MISSING and self.field == (WHOLE,):
            found = message
        return None if found is _MISSING else found


@dataclass(frozen=True, slots=True)
class Action:
    """A command to all processes whose ids match ``target``, or an event (``operation`` event, ``target`` its level)."""

    operation: str
    target: str
    arguments: Mapping[str, Any]
    text: str


@dataclass(frozen=True, slots=True)
class Rule:
    """A rule that was understood."""

    name: str
    table: RuleTable
    condition: Condition
    do: tuple[Action, ...]
    at_end: tuple[Action, ...]


def parse_rule(name: str, table: RuleTable) -> Rule:
    """Return the rule of a table; RuleError says which field is at fault and why."""
    if not _KEY.fullmatch(table.key):
        raise RuleError("key", f"{clip(table.key)!r} is no key expression: parts between '/', '*' for one part, '**' for any number")
    condition = _condition(table)
    if not table.do and not table.at_end:
        raise RuleError("do", "does nothing: give commands in 'do' or 'at_end'")
    if condition.silent and "*" in table.key:
        raise RuleError("when", "silence can be told of one key only: name it without '*'")
    return Rule(name, table, condition, _actions("do", table.do), _actions("at_end", table.at_end))


def message_of(payload: bytes, encoding: str) -> Any:
    """Return what a message says: JSON, msgpack, else text (a number where it is one); ValueError for bytes that are none of them."""
    if encoding.startswith("application/msgpack"):
        return _decoded(msgspec.msgpack.decode, payload)
    if encoding.startswith("application/json") or payload.lstrip()[:1] in (b"{", b"["):
        return _decoded(msgspec.json.decode, payload)
    try:
        text = payload.decode().strip()
    except UnicodeDecodeError:
        return _decoded(msgspec.msgpack.decode, payload)
    return _value(text)


def _condition(table: RuleTable) -> Condition:
    if table.when.strip() == SILENT:
        if table.hysteresis:
            raise RuleError("hysteresis", "silence has none")
        return Condition((), SILENT, 0.0, silent=True)
    match = _CONDITION.fullmatch(table.when)
    if match is None:
        raise RuleError("when", f"{clip(table.when)!r} is no condition: write FIELD > NUMBER (or >= < <= == !=), or {SILENT}")
    field, operator, word = match.groups()
    value = _value(word)
    if operator in _ORDER and not _is_number(value):
        raise RuleError("when", f"{clip(word)!r} is no number, which {operator} compares with")
    if table.hysteresis and operator not in _ORDER:
        raise RuleError("hysteresis", f"only > >= < <= have one, not {operator}")
    return Condition(tuple(field.split(".")), operator, value, table.hysteresis)


def _actions(field: str, texts: Sequence[str]) -> tuple[Action, ...]:
    return tuple(_action(field, text) for text in texts)


def _action(field: str, text: str) -> Action:
    operation, _, rest = text.strip().partition(" ")
    target, _, words = rest.strip().partition(" ")
    if operation == EVENT:
        levels = [level.value for level in Level]
        if target not in levels or not words.strip():
            raise RuleError(field, f"{clip(text)!r}: write event LEVEL TEXT, LEVEL is one of {', '.join(levels)}{nearest(target, levels)}")
        return Action(operation, target, {}, words.strip())
    if not _OPERATION.fullmatch(operation) or not _TARGET.fullmatch(target):
        raise RuleError(field, f"{clip(text)!r} is no command: write OP ID [name=value ...], as in 'stop auv_*'")
    try:
        return Action(operation, target, arguments(operation, tuple(words.split())), text.strip())
    except WordError as error:
        raise RuleError(field, str(error)) from error


def _value(word: str) -> float | str | bool:
    """Return what a word means: true, false, a number, or text, with or without quotes."""
    if word in _WORDS:
        return _WORDS[word]
    try:
        return float(word)
    except ValueError:
        return word[1:-1] if len(word) >= 2 and word[0] == word[-1] and word[0] in "'\"" else word


def _inner(message: Any, path: Sequence[str]) -> Any:
    for part in path:
        if isinstance(message, dict) and part in message:
            message = message[part]  # pyright: ignore[reportUnknownVariableType]  any plain data
        elif isinstance(message, list) and part.isdigit() and int(part) < len(message):  # pyright: ignore[reportUnknownArgumentType]
            message = message[int(part)]  # pyright: ignore[reportUnknownVariableType]
        else:
            return _MISSING
    return message  # pyright: ignore[reportUnknownVariableType]


def _decoded(decode: Callable[[bytes], Any], payload: bytes) -> Any:
    try:
        return decode(payload)
    except (msgspec.MsgspecError, RecursionError) as error:
        raise ValueError(str(error)) from error


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _are_numbers(*values: Any) -> bool:
    return all(_is_number(value) for value in values)
