"""Messages in and out of bytes: which are questions, which are refused at once, which nobody can be told about.

A question without an id cannot be answered, and what is no JSON object is none: both are counted and forgotten, and never end a connection.
"""

import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import msgspec

from rtkmesh_schemas.flockwave import NO_HANDLER, NO_SCHEMA, VERSION, Acknowledged, Body, Message, Refused

MAXIMUM_BYTES: Final = 65536
_decoder: Final = msgspec.json.Decoder()
_encoder: Final = msgspec.json.Encoder()


@dataclass(frozen=True, slots=True)
class Question:
    """A body to be answered; ``id`` None: it came without an envelope, and its answer goes back so."""

    body: dict[str, Any]
    id: str | None = None


@dataclass(frozen=True, slots=True)
class Refusal:
    """A message that is answered with a reason at once."""

    reason: str
    id: str | None = None


def read_message(data: bytes) -> Question | Refusal | None:
    """Return the question in the bytes of an envelope, or why it is none; None where there is nobody to answer."""
    raw = _object(data)
    id_ = raw.get("id") if raw is not None else None
    if raw is None or not isinstance(id_, str):
        return None
    body = raw.get("body")
    extended = isinstance(body, dict) and str(body.get("type", "")).startswith("X-")  # pyright: ignore[reportUnknownMemberType, reportUnknownArgumentType]  any JSON
    if not extended and (refusal := _fault(raw, id_)) is not None:
        return refusal
    if isinstance(raw.get("refs"), str):  # an answer; nothing was asked
        return None
    return Question(raw["body"], id_) if isinstance(body, dict) else Refusal(NO_HANDLER, id_)


def read_any(data: bytes) -> Question | Refusal | None:
    """Return the question in an envelope or a bare body (an object with ``type``)."""
    raw = _object(data)
    if raw is None or "type" not in raw:
        return read_message(data) if raw is not None else Refusal(NO_SCHEMA)
    return Question(raw)


def written(body: Body, refs: str | None = None) -> bytes:
    """Return the envelope of an answer or, without ``refs``, of a notification."""
    envelope: dict[str, Any] = {"$fw.version": VERSION, "id": secrets.token_urlsafe(7)[:10], "body": body}
    return _encoder.encode(envelope if refs is None else {**envelope, "refs": refs})


def bare(body: Body) -> bytes:
    """Return a body alone."""
    return _encoder.encode(body)


def answered(question: Question | Refusal, body: Body) -> bytes:
    """Return an answer as its question came: in an envelope, or alone."""
    return bare(body) if question.id is None else written(body, question.id)


def acknowledged() -> Body:
    """Return ACK-ACK."""
    return Acknowledged(type="ACK-ACK")


def refused(reason: str) -> Body:
    """Return ACK-NAK."""
    return Refused(type="ACK-NAK", reason=reason)


def _fault(raw: Mapping[str, Any], id_: str) -> Refusal | None:
    """Return the refusal of an envelope that breaks the schema."""
    try:
        message = msgspec.convert(raw, Message)
    except msgspec.ValidationError:
        return Refusal(NO_SCHEMA, id_)
    has_body, has_error = message.body is not msgspec.UNSET, message.error is not msgspec.UNSET
    return Refusal(NO_SCHEMA, id_) if has_body == has_error else None


def _object(data: bytes) -> dict[str, Any] | None:
    try:
        raw = _decoder.decode(data) if len(data) <= MAXIMUM_BYTES else None
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return None
    return raw if isinstance(raw, dict) else None  # pyright: ignore[reportUnknownVariableType]  any JSON
