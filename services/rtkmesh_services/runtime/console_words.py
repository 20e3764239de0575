"""Words of a console: abbreviations that are told apart, arguments in the order that RTKRCV's users type them, and cycles.

Shared by `rtkmesh cmd`, `rtkmesh console` and the telnet console. A prefix stands for a word where it is that of one word only:
RTKRCV takes the last of its table, which once saved over a file for ``sa``.
"""

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from rtkmesh_schemas.command import Request
from rtkmesh_schemas.command_limits import fault_of

# RTKRCV's words (its manual, 3.4), in the order of its help.
RTKRCV_WORDS: Final[Mapping[str, str]] = {
    "start": "start rtk server",
    "stop": "stop rtk server",
    "restart": "restart rtk server",
    "solution": "show solution",
    "status": "show rtk status",
    "satellite": "show satellite status",
    "observ": "show observation data",
    "navidata": "show navigation data",
    "stream": "show stream status",
    "error": "show error/warning messages",
    "option": "show option(s)",
    "set": "set option",
    "load": "load options from file",
    "save": "save options to file",
    "mark": "add a mark to the outputs",
    "mode": "change the positioning mode",
    "log": "start/stop log to file",
    "help": "print help",
    "exit": "logout console",
    "shutdown": "shutdown rtk server",
}
CYCLED: Final = frozenset({"solution", "status", "satellite", "observ", "navidata", "stream"})
SCREENS: Final = (CYCLED | {"option", "error"}) - {"status"}  # whose text says it better than the data, which status's does not
_FLAGGED: Final = frozenset({"satellite", "observ", "navidata"})  # -2: two frequencies; of navidata only RTKRCV's own paging
IN_FULL: Final = frozenset({"shutdown"})  # no abbreviation does this
SHORTEST_CYCLE_S: Final = 0.1
LONGEST_CYCLE_S: Final = 3600.0

# An operation's first bare words, in order: ``load FILE`` is load with file=FILE.
_POSITIONAL: Final[Mapping[str, tuple[str, ...]]] = {
    "load": ("file",),
    "save": ("file",),
    "log": ("level",),
    "get": ("key",),
    "set": ("key", "value"),
    "option": ("pattern",),
    "mark": ("name", "comment"),
    "mode": ("mode",),
    "error": ("count",),
    "solution": ("count",),
    "satellite": ("frequencies",),
    "observ": ("frequencies",),
    "preset": ("action", "id"),
    "base": ("id",),
    "help": ("word",),
    "use": ("id",),
    "events": ("switch",),
    "start": ("id",),
    "stop": ("id",),
    "restart": ("id",),
    "output": ("id", "lines"),
}


@dataclass(frozen=True, slots=True)
class Typed:
    """What a line asks for. ``cycle_s``: again and again, with this pause; 0: once."""

    op: str
    args: dict[str, Any] = field(default_factory=dict[str, Any])
    cycle_s: float = 0.0


class WordError(Exception):
    """A line that cannot be understood; the text says why."""


def match_word(typed: str, words: Iterable[str]) -> list[str]:
    """Return the words that are meant: the one written so, else those that begin so (hyphens and capitals do not matter)."""
    name = typed.lower().replace("-", "_")
    folded = {word.lower().replace("-", "_"): word for word in words}
    if name in folded:
        return [folded[name]]
    return sorted(word for key, word in folded.items() if name and key.startswith(name) and word not in IN_FULL)


def typed_line(words: list[str], known: Iterable[str]) -> Typed:
    """Return what a line of words asks for; WordError when its first word is none of ``known``, or several, or an argument is wrong."""
    found = match_word("help" if words[0] == "?" else words[0], known)
    if not found:
        raise WordError(f"unknown command: {words[0]}.")
    if len(found) > 1:
        raise WordError(f"ambiguous command: {words[0]}. ({', '.join(found)})")
    rest, cycle_s = _without_cycle(found[0], words[1:])
    return Typed(found[0], arguments(found[0], rest), cycle_s)


def arguments(op: str, words: Iterable[str]) -> dict[str, Any]:
    """Return the arguments in the words of a command line: name=value, or bare ones where they are usual; WordError for others."""
    values: dict[str, Any] = {}
    names = iter(_POSITIONAL.get(op, ()))
    for word in words:
        name, sign, value = word.partition("=")
        if op in _FLAGGED and re.fullmatch(r"-[a-z]?\d{1,4}", word):
            values |= {"frequencies": int(word[1:])} if word[1:].isdecimal() and op != "navidata" else {}
            continue
        if not sign or not name.replace("_", "").replace(".", "").isalnum():
            name, value = next(names, ""), word
            if not name:
                raise WordError(f"{word!r} is no argument of {op}: write name=value")
        values[name] = _value(value)
    return values


def _without_cycle(op: str, words: list[str]) -> tuple[list[str], float]:
    """Return the words without RTKRCV's cycle (seconds, a number behind a screen's word), and the cycle."""
    if op not in CYCLED:
        return words, 0.0
    for index, word in enumerate(words):
        try:
            cycle_s = float(word) if word[0].isdecimal() or word[0] == "." else None
        except ValueError:
            cycle_s = None
        if cycle_s is not None:
            pause_s = min(max(cycle_s, SHORTEST_CYCLE_S), LONGEST_CYCLE_S) if cycle_s > 0.0 else 0.0
            return [*words[:index], *words[index + 1 :]], pause_s
    return words, 0.0


def _value(text: str) -> Any:
    """Return numbers, true, false and JSON lists as such, everything else as text, also numbers that a command cannot hold."""
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        return text
    return text if fault_of(Request(op="value", args={"value": value})) else value
