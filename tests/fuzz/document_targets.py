"""Everything else that comes from outside: files, casters and their clients, messages and commands of the network.

Each row says which exceptions are its word for "this is no such thing"; any other one is a fault.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, partial
from itertools import islice
from typing import Any, Final

import numpy as np
from tests.codecs import test_antex, test_rinex_navigation, test_rinex_observation
from tests.fuzz.bodies import BINARY, Bytes, bodies
from tests.fuzz.harness import Reader, Target
from tests.schemas.test_wire import example
from tests.services.test_ntrip_protocol import ANSWERS

from rtkmesh.codecs.antex import AntexFile
from rtkmesh.codecs.rinex_navigation import read_navigation
from rtkmesh.codecs.rinex_observation import ObservationReader
from rtkmesh.errors import FormatError
from rtkmesh_schemas.command import Request, request_of
from rtkmesh_schemas.errors import SchemaError
from rtkmesh_schemas.observation import EphemerisMessage, IonosphereMessage, Observation, ReferenceMessage
from rtkmesh_schemas.reference import MESSAGES
from rtkmesh_schemas.wire import JSON, MSGPACK, Wire, decode, encode, encode_json
from rtkmesh_services.ntrip.protocol import AnswerReader, ChunkedBody
from rtkmesh_services.ntrip.request import parse_request
from rtkmesh_services.ntrip.source_table import nearest_names, parse_table, table_row
from rtkmesh_services.runtime.time_tags import TagWriter, parse_tag, parse_times
from rtkmesh_services.solver.inputs import values_of

_TEXT: Final = np.frombuffer(b" \n\n0123456789.-+eED      GRECJ>ACLS/:;,*" + bytes(range(32, 127)) + b"\r\t\x00\xff", np.uint8)
_LIMIT_S: Final = 0.010  # of a document of a few kB


@dataclass(frozen=True, slots=True)
class Document:
    """What reads a document: whole ones to begin with, the bytes that mutations are made of, and the exceptions that are answers."""

    name: str
    read: Callable[[bytes], Any]
    pool: Callable[[], Sequence[bytes]]
    refusals: tuple[type[Exception], ...] = ()
    alphabet: Bytes | None = None
    limit_s: float = _LIMIT_S

    def documents(self, seed: int) -> Iterator[bytes]:
        """Yield mutated documents for ever."""
        pool = self.pool()
        heads = [document[:8].ljust(8) for document in pool]
        return bodies(seed, pool, heads, BINARY if self.alphabet is None else self.alphabet, 3000)

    def reader(self) -> Reader:
        """Return the reader; a refusal is its answer."""

        def feed(data: bytes) -> None:
            with suppress(*self.refusals):
                self.read(data)

        return Reader(feed)


def _observations(data: bytes) -> None:
    reader = ObservationReader(data)
    assert sum(1 for _ in reader) <= len(data)


def _answers(data: bytes) -> None:
    reader, size = AnswerReader(), max(1, len(data) // 3)
    content = b"".join(reader.feed(data[start : start + size]) for start in range(0, len(data), size))
    reader.end()
    assert reader.answer is not None or reader.fault
    assert len(content) <= len(data)


def _chunks(data: bytes) -> None:
    assert len(ChunkedBody().feed(data)) <= len(data)


def _table(data: bytes) -> None:
    mounts = parse_table(data)
    nearest_names("RTCM3", mounts[:100])
    for mount in mounts[:20]:
        table_row(mount)


def _message(data: bytes) -> None:
    """Decode as what the first byte says; what goes to solvers becomes the engine's values as well."""
    names = sorted(MESSAGES)
    message = decode(MESSAGES[names[data[0] % len(names)]], data[1:])
    if isinstance(message, Observation | EphemerisMessage | IonosphereMessage | ReferenceMessage):
        for _ in values_of(message):
            pass


def _command(data: bytes) -> None:
    request_of(data[1:], (MSGPACK, JSON, "")[data[0] % 3], "" if len(data) > 4 else data.decode("latin1"))


@cache
def _messages() -> list[bytes]:
    """Return each message as an example, and those that a simulated ingest publishes."""
    from tests.fuzz.ingest_target import published

    names = sorted(MESSAGES)
    examples = [bytes([number]) + encode(example(MESSAGES[name])) for number, name in enumerate(names)]
    return [*examples, *(bytes([names.index(type(message).__name__)]) + encode(message) for message in islice(published(), 60))]


def _commands() -> list[bytes]:
    requests: list[Wire] = [Request(op="set", args={"name": "x", "value": [1, {"a": None}]}, request_id="1"), Request(op="status")]
    return [b"\x00" + encode(request) for request in requests] + [b"\x01" + encode_json(request) for request in requests]


def _rinex_observations() -> list[bytes]:
    module = test_rinex_observation
    return [(module.V3 + module.V3_EPOCH).encode(), module.V2.encode()]


def _tags() -> list[bytes]:
    writer = TagWriter(10**18, 5)
    return [writer.header + b"".join(writer.record(number * 10**9, number * 80) for number in range(1, 30))]


def _times() -> list[bytes]:
    return [b"".join(b"%d %d %d 80\n" % (number, 10**18 + number * 10**8, number * 10**8) for number in range(30))]


_TABLE: Final = b"STR;RTCM32;Berlin;RTCM 3.2;1077(1),1006(10);2;GPS+GLO;EUREF;DEU;52.5;13.4;1;1;sNTRIP;none;B;N;9600;\r\nENDSOURCETABLE\r\n"
_REQUEST: Final = b"GET /RTCM32 HTTP/1.1\r\nHost: x\r\nNtrip-Version: Ntrip/2.0\r\nUser-Agent: NTRIP x\r\nAuthorization: Basic dTpw\r\n\r\n"

DOCUMENTS: Final = (
    Document("rinex_obs", _observations, _rinex_observations, (FormatError,), _TEXT),
    Document("rinex_nav", read_navigation, lambda: [test_rinex_navigation.WHOLE], (FormatError,), _TEXT),
    Document(
        "antex", lambda data: list(AntexFile(data)), lambda: [test_antex.text(test_antex.SATELLITE, test_antex.antenna()).encode()],
        (FormatError,), _TEXT,
    ),
    Document("tag", partial(parse_tag, log_bytes=2000), _tags),
    Document("times", parse_times, _times, (), _TEXT),
    Document("ntrip_answer", _answers, lambda: list(ANSWERS.values())),
    Document("ntrip_chunks", _chunks, lambda: [b"5\r\nhello\r\n1f;x=1\r\n" + bytes(31) + b"\r\n0\r\n\r\n"]),
    Document("ntrip_request", parse_request, lambda: [_REQUEST]),
    Document("ntrip_table", _table, lambda: [_TABLE, _TABLE * 9], (), _TEXT),
    Document("messages", _message, _messages, (SchemaError,)),
    Document("commands", _command, _commands, (SchemaError,)),
)  # fmt: skip


def targets() -> list[Target]:
    """Return the targets of documents."""
    return [Target(document.name, document.documents, document.reader, 0.005, document.limit_s) for document in DOCUMENTS]
