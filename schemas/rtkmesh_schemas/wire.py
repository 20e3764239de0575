"""Bytes on the wire: msgpack maps, or JSON for commands; the encoding names the type and its major version.

Four rules keep old and new programs talking: new fields have defaults, types of fields never change, fields are never
reused, and a new major version is refused by name instead of guessed at.
"""

import threading
from typing import Any, Final, TypeVar

import msgspec

from rtkmesh_schemas.errors import DecodeError, VersionError

MSGPACK: Final = "application/msgpack"
JSON: Final = "application/json"
MAXIMUM_BYTES: Final = 65536  # of one put (DESIGN.md 12)
MAXIMUM_COMMAND_BYTES: Final = 16384


class Wire(msgspec.Struct, frozen=True, kw_only=True):
    """Root of the structs on the wire: frozen maps; unknown fields of newer minor versions are ignored."""


T = TypeVar("T", bound=Wire)

_encoder = msgspec.msgpack.Encoder()
_json_encoder = msgspec.json.Encoder()
_decoders: dict[type[Any], msgspec.msgpack.Decoder[Any]] = {}
_json_decoders: dict[type[Any], msgspec.json.Decoder[Any]] = {}
# msgspec builds what it knows of a struct on first use, and two threads that do so at once end the process (seen with 0.22: SIGSEGV).
_making = threading.Lock()

# Types whose first incompatible change has happened; all others are at 1.
MAJORS: Final[dict[str, int]] = {}


def encoding_of(type_: type[Wire], base: str = MSGPACK) -> str:
    """Return the Zenoh encoding of a struct: ``application/msgpack;rtkmesh.<Type>/<major>``."""
    return f"{base};rtkmesh.{type_.__name__}/{MAJORS.get(type_.__name__, 1)}"


def encode(value: Wire) -> bytes:
    """Return the msgpack bytes of a struct."""
    return _encoder.encode(value)


def encode_json(value: Any) -> bytes:
    """Return the JSON bytes of a struct or plain value (NaN becomes null)."""
    return _json_encoder.encode(value)


def decode(type_: type[T], data: bytes, encoding: str = "") -> T:
    """Return the struct in ``data``; VersionError for another major, DecodeError for anything else that is wrong."""
    check_encoding(type_, encoding)
    if encoding.startswith(JSON):
        return decode_json(type_, data)
    decoder = _decoders.get(type_)
    if decoder is None:
        with _making:
            decoder = _decoders[type_] = msgspec.msgpack.Decoder(type_)
    return _decoded(decoder, type_, data)


def decode_json(type_: type[T], data: bytes) -> T:
    """Return the struct in JSON ``data``; DecodeError if it is none."""
    decoder = _json_decoders.get(type_)
    if decoder is None:
        with _making:
            decoder = _json_decoders[type_] = msgspec.json.Decoder(type_)
    return _decoded(decoder, type_, data)


def _decoded(decoder: "msgspec.msgpack.Decoder[T] | msgspec.json.Decoder[T]", type_: type[T], data: bytes) -> T:
    try:
        return decoder.decode(data)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise DecodeError(f"no {type_.__name__}: {error}") from error


def check_encoding(type_: type[Wire], encoding: str) -> None:
    """Raise VersionError if the encoding names this type with another major version, DecodeError if another type."""
    _, _, schema = encoding.partition(";")
    if not schema.startswith("rtkmesh."):
        return
    name, _, major = schema.removeprefix("rtkmesh.").partition("/")
    if name != type_.__name__:
        raise DecodeError(f"expected {type_.__name__}, got {name}")
    if major != str(MAJORS.get(name, 1)):
        raise VersionError(f"{name}/{major} is not {name}/{MAJORS.get(name, 1)}, which this version speaks")
