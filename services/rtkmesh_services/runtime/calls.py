"""Asking a process to do something, and saying by name why it did not.

An empty answer has many causes (absent, just reconnecting, crashed, forbidden, too large), so it is asked again with the same
request id until the deadline and then compared with the liveliness tokens: absent, hung or refused.
"""

import difflib
import getpass
import os
import socket
import time
import uuid
from collections.abc import Callable, Mapping
from typing import Any, Final

import msgspec

from rtkmesh_schemas.command import Code, Reply, Request
from rtkmesh_schemas.errors import SchemaError
from rtkmesh_schemas.keys import CMD, check_id, stream_of
from rtkmesh_schemas.wire import decode, encode, encoding_of
from rtkmesh_services.runtime.bus import Answer, Bus

_PAUSE_S: Final = 0.05
_SHORTEST_S: Final = 0.1


def call(
    bus: Bus,
    id: str,  # noqa: A002  the word of the design
    op: str,
    args: Mapping[str, Any] | None = None,
    deadline_s: float = 2.0,
    *,
    caller: str = "",
    expires_s: float = 0.0,
    pause: Callable[[float], None] = time.sleep,
) -> list[Reply]:
    """Ask process ``id`` to do ``op``; return its reply, or one that says absent, hung or refused.

    ``*`` asks all: one reply for each that answered and each that holds a token; empty only when nobody is there. ``expires_s``: not to be
    done later than in so many seconds (0: whenever it comes); say it only where the clocks of both hosts agree.
    """
    check_id(id)
    expires_utc_ns = time.time_ns() + round(expires_s * 1e9) if expires_s else 0
    request = Request(
        op=op, args=dict(args or {}), request_id=uuid.uuid4().hex, caller=caller or default_caller(), expires_utc_ns=expires_utc_ns
    )
    deadline = time.monotonic() + deadline_s
    before = bus.live(timeout_s=min(deadline_s, 1.0))
    replies: dict[str, Reply] = {}
    timed_out = False
    while True:
        left_s = deadline - time.monotonic()
        answers = bus.get(CMD.key(id), payload=encode(request), encoding=encoding_of(Request), timeout_s=max(left_s, _SHORTEST_S))
        timed_out = timed_out or any(answer.timed_out for answer in answers)
        replies.update((reply.id, reply) for answer in answers if (reply := _reply_of(answer)) is not None)
        expected = {id} if id != "*" else set(before)
        if (replies and expected <= set(replies)) or (id == "*" and not expected) or time.monotonic() + _PAUSE_S > deadline:
            break
        pause(_PAUSE_S)
    return _complete(bus, id, request, before, replies, timed_out=timed_out)


def default_caller() -> str:
    """Return who asks, for the log of who is asked: user@host:pid."""
    try:
        user = getpass.getuser()
    except (KeyError, OSError):
        user = str(os.getuid())
    return f"{user}@{socket.gethostname()}:{os.getpid()}"


def _complete(
    bus: Bus,
    id: str,  # noqa: A002
    request: Request,
    before: dict[str, str],
    replies: dict[str, Reply],
    *,
    timed_out: bool,
) -> list[Reply]:
    live = {} if id != "*" and replies else bus.live()
    silent = [name for name in ({**before, **live} if id == "*" else [id]) if name not in replies]
    for name in silent:
        code, message = _why_silent(name, before, live, timed_out=timed_out)
        replies[name] = Reply(ok=False, code=code, message=message, request_id=request.request_id, id=name)
    return [replies[name] for name in sorted(replies)]


def _why_silent(name: str, before: dict[str, str], live: dict[str, str], *, timed_out: bool) -> tuple[Code, str]:
    if name in live and timed_out:
        return Code.HUNG, f"{live[name]} {name} is there and does not answer: it hangs"
    if name in live:
        return Code.REFUSED, f"{live[name]} {name} is there, but the question was not let through (access rules, size)"
    if name in before:
        return Code.HUNG, f"{before[name]} {name} did not answer and left the network"
    if timed_out:
        return Code.HUNG, f"{name} does not answer and is not on the network: it hangs or is ending"
    near = difflib.get_close_matches(name, live, 1)
    hint = f"; did you mean {near[0]!r}?" if near else f"; there are {', '.join(sorted(live))}" if live else "; nobody is"
    return Code.ABSENT, f"no process {name!r} is on the network{hint}"


def _reply_of(answer: Answer) -> Reply | None:
    """Return the reply in an answer, with its id from the key if it says none; None for Zenoh's own errors."""
    try:
        reply = decode(Reply, answer.payload, answer.encoding)
    except SchemaError:
        return None
    found = stream_of(answer.key)
    name = reply.id or (found[1] if found else "")
    return msgspec.structs.replace(reply, id=name) if name else None
