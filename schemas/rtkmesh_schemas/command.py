"""Commands to ``rtk/{id}/cmd`` and their replies."""

from enum import StrEnum
from typing import Any
from urllib.parse import unquote_plus

import msgspec

from rtkmesh_schemas.errors import DecodeError
from rtkmesh_schemas.wire import MAXIMUM_COMMAND_BYTES, Wire, decode, decode_json


class Code(StrEnum):
    """Why a command was answered as it was."""

    OK = "ok"
    ACCEPTED = "accepted"
    UNKNOWN_OP = "unknown_op"
    BAD_ARGUMENTS = "bad_arguments"
    BAD_REQUEST = "bad_request"
    WRONG_STATE = "wrong_state"
    NOT_ALLOWED = "not_allowed"
    NOT_FOUND = "not_found"
    FAILED = "failed"
    TOO_LARGE = "too_large"
    STALE = "stale"
    CONFLICT = "conflict"
    # Said by the client, in place of an empty answer.
    ABSENT = "absent"
    HUNG = "hung"
    REFUSED = "refused"
    UNREACHABLE = "unreachable"


class Request(Wire, frozen=True, kw_only=True):
    """A command. A repeated ``request_id`` gets the first answer again, one of another command is refused. ``caller`` is who asks.

    A command that comes too late is refused: after ``expires_utc_ns``, or more than ten seconds after ``issued_utc_ns`` (UTC, ns since
    1970; 0: not said), or for another run of the process than ``start_id``. Say these only where the clocks of both hosts agree.
    """

    op: str
    args: dict[str, Any] = {}
    request_id: str = ""
    caller: str = ""
    issued_utc_ns: int = 0
    expires_utc_ns: int = 0
    start_id: str = ""


class Reply(Wire, frozen=True, kw_only=True):
    """The answer: ``message`` for people, ``code`` for programs, ``data`` typed, the process's ``state`` after it.

    ``text``: what RTKRCV's console shows for the word, lines ended by LF; empty where it shows nothing but the message.
    """

    ok: bool
    code: Code
    message: str = ""
    state: str = ""
    data: dict[str, Any] = {}
    request_id: str = ""
    id: str = ""
    text: str = ""


def request_of(payload: bytes, encoding: str, parameters: str) -> Request:
    """Return the request in a query: payload (msgpack or JSON, told apart by content) or selector parameters ``op=stop&...``.

    DecodeError says what is wrong: too large, neither form, or no ``op``.
    """
    if len(payload) > MAXIMUM_COMMAND_BYTES or len(parameters) > MAXIMUM_COMMAND_BYTES:
        raise DecodeError(f"a command may have at most {MAXIMUM_COMMAND_BYTES} bytes")
    if not payload:
        return _from_parameters(parameters)
    if encoding.startswith("application/json") or payload.lstrip()[:1] == b"{":
        return decode_json(Request, payload)
    if payload[:1].isalpha() and payload.replace(b"_", b"").replace(b"-", b"").isalnum():
        return Request(op=payload.decode())  # a bare word, as a person types it
    return decode(Request, payload)


def _from_parameters(parameters: str) -> Request:
    pairs = [part.partition("=") for part in parameters.replace("&", ";").split(";") if part]
    values = {unquote_plus(name): unquote_plus(value) for name, _, value in pairs}
    op = values.pop("op", "")
    if not op:
        raise DecodeError("no op: send {op, args} as JSON or msgpack, or ?op=status")
    request = Request(op=op, request_id=values.pop("request_id", ""), caller=values.pop("caller", ""), start_id=values.pop("start_id", ""))
    times = {name: _nanoseconds(name, values.pop(name, "0")) for name in ("issued_utc_ns", "expires_utc_ns")}
    return msgspec.structs.replace(request, args=dict(values), **times)


def _nanoseconds(name: str, text: str) -> int:
    if not text.isdecimal() or len(text) > 20:
        raise DecodeError(f"{name} is a whole number of nanoseconds")
    return int(text)


def plain(value: Wire) -> dict[str, Any]:
    """Return a struct as a plain dict for ``Reply.data``."""
    result: dict[str, Any] = msgspec.to_builtins(value)
    return result
