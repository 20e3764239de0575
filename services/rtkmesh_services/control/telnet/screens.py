"""Replies as RTKRCV's console shows them: lines ended by CR LF, a screen's head in bold, nothing that a terminal would obey."""

import json
from collections.abc import Mapping
from typing import Any, Final

from rtkmesh_schemas.command import Code, Reply
from rtkmesh_services.runtime.console_words import RTKRCV_WORDS

PROMPT: Final = b"rtkrcv> "
PASSWORD: Final = b"password: "
CLEAR: Final = b"\x1b[H\x1b[2J"
BANNER: Final = b"\r\n\x1b[1m** rtkrcv ver.rtkmesh %s console (h:help) **\x1b[0m\r\n"
HEADED: Final = frozenset({"status", "satellite", "observ", "navidata", "stream"})
_USAGES: Final[Mapping[str, str]] = {
    **{word: f"{word} [cycle]" for word in ("solution", "status", "navidata", "stream")},
    **{word: f"{word} [-n] [cycle]" for word in ("satellite", "observ")},
    "option": "option [opt]",
    "set": "set opt val",
    "load": "load file",
    "save": "save [file]",
    "mark": "mark [name] [comment]",
    "mode": "mode [mode]",
    "log": "log [level]",
    "help": "help|?",
    "exit": "exit|ctr-D",
}
MAXIMUM_TEXT: Final = 1 << 18


def shown(word: str, reply: Reply) -> bytes:
    """Return what the console shows of a reply to a word."""
    text = reply.text or (_values(reply.data) if word in HEADED and reply.ok else "")
    if not text:
        return wire(_answer(word, reply))
    if word not in HEADED:
        return wire(text)
    head, _, rest = text.lstrip("\n").partition("\n")
    return b"\r\n\x1b[1m" + wire(head).removesuffix(b"\r\n") + b"\x1b[0m\r\n" + wire(rest)


def wire(text: str) -> bytes:
    """Return text for a terminal: CR LF, at its end too; control characters are none of ours."""
    lines = text[:MAXIMUM_TEXT].removesuffix("\n").split("\n") if text else []
    plain = ("".join(sign if sign.isprintable() else "?" for sign in line.removesuffix("\r")) for line in lines)
    return "".join(f"{line}\r\n" for line in plain).encode("utf-8", "replace")


def help_page(version: str) -> str:
    """Return the page of words, in RTKRCV's layout."""
    lines = [f"rtkrcv (ver.rtkmesh {version})"]
    lines += [f"{_USAGES.get(word, word):<22}: {text}" for word, text in RTKRCV_WORDS.items()]
    return "\n".join(lines)


def _answer(word: str, reply: Reply) -> str:
    """Return the short answer; a failure of RTKRCV's servers is worded as it words them."""
    if reply.ok or reply.code in (Code.ABSENT, Code.HUNG) or word not in ("start", "stop", "restart"):
        return reply.message
    stated = reply.message.removeprefix("rtk ")
    return reply.message if reply.message.startswith(f"rtk server {word} error") else f"rtk server {word} error ({stated})"


def _values(data: dict[str, Any]) -> str:
    """Return data as ``name : value`` lines, where a process has no layout for the word."""
    rows = (f"{name:<28}: {value if isinstance(value, (str, int, float)) else json.dumps(value)}" for name, value in data.items())
    return "\n".join(("Parameter                   : Value", *rows))
