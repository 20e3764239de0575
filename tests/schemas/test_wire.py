"""Bytes on the wire: pinned by golden files, tolerant of newer minor versions, strict about majors."""

import math
import threading
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtkmesh_schemas import wire
from rtkmesh_schemas.command import Code, Reply, Request
from rtkmesh_schemas.errors import DecodeError, VersionError
from rtkmesh_schemas.reference import MESSAGES
from rtkmesh_schemas.status import ServiceStatus, State
from rtkmesh_schemas.wire import Wire, decode, encode, encode_json, encoding_of

GOLDEN = Path(__file__).parent / "golden"

_EXAMPLES: dict[type, Any] = {bool: True, int: 7, float: 0.5, str: "word", bytes: b"\x00\x01\xfe\xff"}


def example(annotation: Any) -> Any:
    """Return a value of a field's type, the same for ever: what the golden files hold."""
    if annotation in _EXAMPLES:
        return _EXAMPLES[annotation]
    if isinstance(annotation, type) and issubclass(annotation, msgspec.Struct):
        return annotation(**{field.name: example(field.type) for field in msgspec.structs.fields(annotation)})
    origin, arguments = getattr(annotation, "__origin__", None), getattr(annotation, "__args__", ())
    if origin is tuple:
        return tuple(example(part) for part in arguments if part is not Ellipsis)
    if origin is list:
        return [example(arguments[0])]
    if origin is dict:
        return {"key": "value" if arguments[1] is Any else example(arguments[1])}
    if isinstance(annotation, type) and issubclass(annotation, str):
        return next(iter(annotation))  # an enumeration
    return example(arguments[0])  # a union: its first type


@pytest.mark.parametrize("name", sorted(MESSAGES))
def test_the_bytes_of_a_message_are_those_of_the_golden_file(name: str):
    """A change of these bytes is a change of the wire: fields may be added at the end with defaults, nothing else."""
    golden = (GOLDEN / f"{name}.msgpack").read_bytes()
    message = example(MESSAGES[name])
    assert decode(MESSAGES[name], golden, encoding_of(MESSAGES[name])) == message
    assert encode(message) == golden


def test_every_golden_file_is_of_a_message():
    """No golden file of a removed message lies about: removing one is a break of the wire."""
    assert {path.stem for path in GOLDEN.glob("*.msgpack")} == set(MESSAGES)


@pytest.mark.parametrize("name", sorted(MESSAGES))
def test_newer_fields_are_ignored(name: str):
    """A message of a newer minor version is read."""
    message = example(MESSAGES[name])
    newer = msgspec.msgpack.encode({**msgspec.to_builtins(message, builtin_types=(bytes,)), "a_newer_field": [1, {"x": 2}]})
    assert decode(MESSAGES[name], newer) == message


def test_another_major_is_refused_by_name():
    """What must not be guessed at is refused before it is decoded."""
    payload = encode(Request(op="status"))
    with pytest.raises(VersionError, match="Request/2 is not Request/1"):
        decode(Request, payload, "application/msgpack;rtkmesh.Request/2")
    with pytest.raises(DecodeError, match="expected Request, got Reply"):
        decode(Request, payload, encoding_of(Reply))


def test_json_and_msgpack_are_told_apart_by_the_encoding():
    """A reply reads the same in both."""
    reply = Reply(ok=True, code=Code.OK, message="ü", data={"a": [1, 2.5, None]})
    assert decode(Reply, encode_json(reply), "application/json;rtkmesh.Reply/1") == reply
    assert decode(Reply, encode(reply), encoding_of(Reply)) == reply


def test_not_a_number_survives_msgpack():
    """NaN is 'not known' on the wire."""
    status = ServiceStatus(id="a", role="hub", state=State.RUNNING, start_id="s", heartbeat=1, uptime_s=math.nan)
    assert math.isnan(decode(ServiceStatus, encode(status)).uptime_s)


@given(st.binary(max_size=300), st.sampled_from(sorted(MESSAGES)))
def test_no_bytes_raise_anything_but_a_decode_error(payload: bytes, name: str):
    """Any payload gives a message or a DecodeError."""
    try:
        message = decode(MESSAGES[name], payload)
    except DecodeError:
        return
    assert isinstance(message, Wire)


@given(st.sampled_from(sorted(MESSAGES)), st.integers(min_value=0), st.integers(min_value=0, max_value=255))
def test_a_damaged_message_never_raises_anything_else(name: str, place: int, byte: int):
    """One wrong byte in a real message gives a message or a DecodeError."""
    payload = bytearray(encode(example(MESSAGES[name])))
    payload[place % len(payload)] = byte
    try:
        decode(MESSAGES[name], bytes(payload))
    except DecodeError:
        return


def test_decoders_are_made_one_at_a_time(monkeypatch: pytest.MonkeyPatch):
    """Two threads that meet a type for the first time do not both build msgspec's knowledge of it: that ends the process."""
    inside, most, made = threading.Semaphore(0), 0, msgspec.msgpack.Decoder
    entered = 0

    def slow(type_: type[Any]) -> Any:
        nonlocal entered, most
        entered += 1
        most = max(most, entered)
        inside.acquire(timeout=0.1)  # the other thread, were it let in, would release it
        decoder = made(type_)
        entered -= 1
        inside.release()
        return decoder

    monkeypatch.setattr(wire, "_decoders", {})
    monkeypatch.setattr(msgspec.msgpack, "Decoder", slow)
    payload = encode(Request(op="status"))
    threads = [threading.Thread(target=decode, args=(Request, payload)) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == 1
