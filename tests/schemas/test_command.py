"""What a question to rtk/{id}/cmd may look like."""

import json

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtkmesh_schemas.command import Request, request_of
from rtkmesh_schemas.errors import SchemaError
from rtkmesh_schemas.wire import MAXIMUM_COMMAND_BYTES, encode, encode_json, encoding_of

REQUEST = Request(op="load", args={"file": "a.toml"}, request_id="7", caller="me")


@pytest.mark.parametrize(
    ("payload", "encoding", "parameters"),
    [
        (encode(REQUEST), encoding_of(Request), ""),
        (encode(REQUEST), "zenoh/bytes", ""),
        (encode_json(REQUEST), "application/json", ""),
        (encode_json(REQUEST), "zenoh/bytes", ""),
        (b" \n" + encode_json(REQUEST), "", ""),
        (b"", "", "op=load;file=a.toml;request_id=7;caller=me"),
        (b"", "", "op=load&file=a.toml&request_id=7&caller=me"),
        (b"", "", "op=load;file=%61.toml;request_id=7;caller=me"),
    ],
)
def test_msgpack_json_and_parameters_say_the_same(payload: bytes, encoding: str, parameters: str):
    """All forms of a question are one request."""
    assert request_of(payload, encoding, parameters) == REQUEST


def test_a_bare_word_is_an_operation():
    """A person may type only the word."""
    assert request_of(b"status", "", "") == Request(op="status")


@pytest.mark.parametrize(
    ("payload", "parameters"),
    [(b"", ""), (b"", "file=x"), (b"{", ""), (b"[1]", ""), (b'{"op": 5}', ""), (b"\xc1", ""), (b"\x93\x01", ""), (b"{" * 5000, "")],
)
def test_what_is_no_request_is_refused(payload: bytes, parameters: str):
    """Wrong payloads are a SchemaError, nothing else."""
    with pytest.raises(SchemaError):
        request_of(payload, "", parameters)


def test_too_large_is_refused_before_it_is_decoded():
    """16 KiB is the limit of a command."""
    with pytest.raises(SchemaError, match="at most"):
        request_of(json.dumps({"op": "x" * MAXIMUM_COMMAND_BYTES}).encode(), "", "")


@given(
    st.binary(max_size=200),
    st.sampled_from(["", "application/json", "application/msgpack;rtkmesh.Request/1", "zenoh/bytes"]),
    st.text(max_size=50),
)
def test_no_bytes_raise_anything_but_a_schema_error(payload: bytes, encoding: str, parameters: str):
    """Any payload, encoding and parameters give a request or a SchemaError."""
    try:
        request = request_of(payload, encoding, parameters)
    except SchemaError:
        return
    assert isinstance(request.op, str)


@pytest.mark.parametrize("payload", [b'{"op":"x","args":{"a":' + b"[" * 7000 + b"]" * 7000 + b"}}", b"\x81\xa1a" * 5000])
def test_deep_nesting_is_refused(payload: bytes):
    """Nesting as deep as 16 KiB allow neither overflows the stack nor passes."""
    with pytest.raises(SchemaError):
        request_of(payload, "", "")


def test_unknown_fields_of_newer_clients_are_ignored():
    """A newer minor version may say more."""
    payload = msgspec.msgpack.encode({"op": "status", "deadline_s": 5.0})
    assert request_of(payload, encoding_of(Request), "") == Request(op="status")
