"""``rtkmesh echo``: messages as they come, our own decoded, others raw."""

import struct
import sys
import time
from typing import Annotated, Any, Final, cast

import msgspec
from cyclopts import Parameter

from rtkmesh_schemas.errors import SchemaError
from rtkmesh_schemas.keys import ROOT, STREAMS, Stream, stream_of
from rtkmesh_schemas.observation import Observation
from rtkmesh_schemas.reference import MESSAGES
from rtkmesh_schemas.wire import Wire, decode
from rtkmesh_services.cli.network import DEFAULT_ENDPOINT, EXIT_OK, EXIT_TIMEOUT, Connect, Json, Namespace, reach
from rtkmesh_services.cli.page import command_page
from rtkmesh_services.runtime.bus import Sample
from rtkmesh_services.runtime.inbox import Inbox
from rtkmesh_services.runtime.logs import clean

_COLUMN_TYPES: Final = {"channel": "<b", "flags": "<B"}
_PREVIEW_BYTES: Final = 64
_POLL_S: Final = 0.2

_EXAMPLES = """
rtkmesh echo rtk/sol -n 1
rtkmesh echo rtk/sol/llh
rtkmesh echo '*/event/*' --json
rtkmesh echo 'rover/eph/*'
"""


def echo(
    expression: Annotated[str, Parameter(help="A key expression, with or without the leading rtk/: rover/sol, '*/status', 'rtk/**'.")],
    /,
    *,
    count: Annotated[int, Parameter(name=["--count", "-n"], help="End after so many messages; 0: never.")] = 0,
    timeout: Annotated[float, Parameter(help="End with exit code 124 when nothing came for so many seconds; 0: never.")] = 0.0,
    as_json: Json = False,
    connect: Connect = DEFAULT_ENDPOINT,
    namespace: Namespace = "",
) -> int:
    """Print messages as they come: ours decoded, others raw. Cached ones (status, event, eph, ref) come at once.

    Exit codes: 0 done, 3 not reachable, 124 nothing came within --timeout.
    """
    expression = full_expression(expression)
    inbox, shown, last_s = Inbox(), 0, time.monotonic()
    with reach(connect, namespace) as bus:
        bus.subscribe(expression, inbox.put, history=True)
        while not count or shown < count:
            sample = inbox.get(_POLL_S)
            if sample is None:
                if timeout and time.monotonic() - last_s > timeout:
                    return EXIT_TIMEOUT
                continue
            shown, last_s = shown + 1, time.monotonic()
            sys.stdout.write(line_of(sample) if as_json else page_of(sample))
            sys.stdout.flush()
    return EXIT_OK


def full_expression(text: str) -> str:
    """Return the key expression meant by ``rover/sol`` or ``rtk/rover/sol``; ``rtk/sol`` is that of the process called rtk."""
    if text.startswith(("**", "@")) or (text.startswith(f"{ROOT}/") and any(_may_match(text, stream) for stream in STREAMS)):
        return text
    return f"{ROOT}/{text}"


def _may_match(text: str, stream: Stream) -> bool:
    chunks, others = text.split("/"), stream.expression().split("/")
    wild = {"*", "**"}
    same = (chunk in wild or other in wild or chunk == other for chunk, other in zip(chunks, others, strict=False))
    return "**" in chunks or (len(chunks) == len(others) and all(same))


def line_of(sample: Sample) -> str:
    """Return one line of JSON: key, encoding, and the message as value, text or hexadecimal."""
    return msgspec.json.encode({"key": sample.key, "encoding": sample.encoding, **_content(sample)}).decode() + "\n"


def page_of(sample: Sample) -> str:
    """Return the message for people."""
    content = _content(sample)
    lines = [f"--- {sample.key}  {sample.encoding}  {len(sample.payload)} bytes"]
    if "value" in content:
        lines += [f"{name}: {_short(value)}" for name, value in content["value"].items()]
    else:
        lines += [f"{value}" for value in content.values()]
    return clean("\n".join(lines)) + "\n"


def decoded(sample: Sample) -> Wire | None:
    """Return our struct in a message, None if it is none."""
    found = stream_of(sample.key)
    type_ = MESSAGES.get(found[0].type) if found is not None else None
    try:
        return None if type_ is None else decode(type_, sample.payload, sample.encoding)
    except SchemaError:
        return None


def _content(sample: Sample) -> dict[str, Any]:
    message = decoded(sample)
    if message is not None:
        return {"value": _plain(message)}
    if sample.encoding.startswith("text/") or sample.encoding == "zenoh/string":
        return {"text": sample.payload.decode(errors="replace")}
    return {"hex": sample.payload[:_PREVIEW_BYTES].hex() + ("..." if len(sample.payload) > _PREVIEW_BYTES else "")}


def _plain(message: Wire) -> dict[str, Any]:
    """Return the message as plain values; the columns of an epoch as lists of numbers."""
    values: dict[str, Any] = msgspec.to_builtins(message, builtin_types=(bytes,))
    if isinstance(message, Observation):
        for name, value in values.items():
            if isinstance(value, bytes):
                values[name] = _column(_COLUMN_TYPES.get(name, "<d"), value)
    return values


def _column(code: str, data: bytes) -> list[Any]:
    return [number for (number,) in struct.iter_unpack(code, data[: len(data) // struct.calcsize(code) * struct.calcsize(code)])]


def _short(value: Any) -> str:
    text = _text(value) if isinstance(value, (list, tuple, dict)) else str(value)
    return text if len(text) <= 400 else f"{text[:400]} ..."  # an epoch has hundreds of numbers


def _text(value: Any) -> str:
    """Return what JSON writes, but nan and inf as they are: one is not known, the other not bounded, and JSON has null for both."""
    if isinstance(value, float):
        return str(value)
    if isinstance(value, (list, tuple)):
        return f"[{','.join(map(_text, cast('list[Any]', value)))}]"
    if isinstance(value, dict):
        items = cast("dict[str, Any]", value).items()
        return f"{{{','.join(f'{_text(name)}:{_text(item)}' for name, item in items)}}}"
    return msgspec.json.encode(value).decode()


app = command_page(echo, _EXAMPLES)
