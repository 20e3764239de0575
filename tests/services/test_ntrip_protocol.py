"""What casters send becomes an answer and content: however it is cut, whatever it is; source tables and positions."""

import itertools
from dataclasses import replace
from math import isnan

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.services.scripted_caster import chunked

from rtkmesh_services.errors import SourceError
from rtkmesh_services.ingest.gga import gga_sentence
from rtkmesh_services.ntrip.address import CasterAddress, parse_caster, shown_url
from rtkmesh_services.ntrip.connection import refused
from rtkmesh_services.ntrip.place import Place
from rtkmesh_services.ntrip.protocol import (
    MAXIMUM_CHUNK_LINE,
    MAXIMUM_HEADER,
    Answer,
    AnswerReader,
    push_request,
    stream_request,
)
from rtkmesh_services.ntrip.request import is_allowed, parse_request
from rtkmesh_services.ntrip.source_table import MountPoint, nearest_mount, nearest_names, parse_table, table_row

DATA = bytes(range(200, 256)) * 3 + b"\r\nplain: text\r\n" + bytes(50)
ADDRESS = CasterAddress("caster.example", 2101, "MOUNT", "me", "pass")
CHUNKED = b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n"
ANSWERS = {
    "v1": b"ICY 200 OK\r\n" + DATA,
    "v1 blank line": b"ICY 200 OK\r\n\r\n" + DATA,
    "v1 headers": b"ICY 200 OK\r\nServer: NTRIP Caster 1.5\r\nDate: 1/Jan/2026\r\n\r\n" + DATA,
    "v1 bare lines": b"ICY 200 OK\n" + DATA,
    "v2 identity": b"HTTP/1.1 200 OK\r\nContent-Type: gnss/data\r\n\r\n" + DATA,
    "v2 no type": b"HTTP/1.1 200 OK\r\nServer: x\r\n\r\n" + DATA,
    "v2 chunked": CHUNKED + chunked([DATA[:7], DATA[7:60], DATA[60:]]),
    "v2 extensions": b"HTTP/1.1 200 OK\r\ntransfer-encoding: Chunked\r\n\r\n" + chunked([DATA[:7], DATA[7:]], b' ; name="a;b"'),
    "v2 ended": CHUNKED + chunked([DATA]) + b"0\r\nTrailer: x\r\n\r\nmore",
    "blank lines before": b"\r\n\r\nICY 200 OK\r\n" + DATA,
}


def read(pieces: list[bytes]) -> tuple[AnswerReader, bytes]:
    reader = AnswerReader()
    return reader, b"".join([reader.feed(piece) for piece in pieces])


def cut(data: bytes, places: list[int]) -> list[bytes]:
    edges = [0, *sorted(min(place, len(data)) for place in places), len(data)]
    return [data[a:b] for a, b in itertools.pairwise(edges)]


@pytest.mark.parametrize("sent", ANSWERS.values(), ids=ANSWERS)
def test_all_content_of_every_kind_of_answer_arrives(sent: bytes):
    for pieces in ([sent], [sent[i : i + 1] for i in range(len(sent))]):
        reader, content = read(pieces)
        assert (reader.fault, content) == ("", DATA)
        assert reader.answer is not None
        assert reader.answer.status == 200


@given(st.sampled_from(list(ANSWERS.values())), st.lists(st.integers(0, 600), max_size=8))
def test_any_split_gives_the_same(sent: bytes, places: list[int]):
    assert read(cut(sent, places))[1] == DATA


@given(
    st.lists(st.binary(max_size=300), max_size=10),
    st.sampled_from([b"", b"ICY ", CHUNKED]),
)
def test_any_bytes_are_a_fault_or_content_and_never_raise(pieces: list[bytes], before: bytes):
    reader = AnswerReader()
    for piece in [before, *pieces]:
        reader.feed(piece)
        assert len(reader._pending) <= MAXIMUM_HEADER + 300
    reader.end()
    assert reader.answer is not None or reader.fault


@pytest.mark.parametrize("endless", [b"ICY 200 OK\r\n" + b"X-Line: 1\r\n" * 100000, b"HTTP/1.1 200 OK\r\n" + b"a" * 50000, b"\r\n" * 50000])
def test_an_endless_header_is_a_fault(endless: bytes):
    reader, content = read(cut(endless, list(range(0, len(endless), 1000))))
    assert "without end" in reader.fault
    assert content == b""
    assert reader.answer is None


def test_an_endless_chunk_header_is_a_fault():
    reader, _ = read([CHUNKED, b"5;" + b"x" * (MAXIMUM_CHUNK_LINE + 10)])
    assert "chunk" in reader.fault


def test_unchunked_data_that_claims_to_be_chunked_is_a_fault():
    assert "no chunk" in read([CHUNKED, b"\xd3\x00\x13 data\n"])[0].fault


@pytest.mark.parametrize(
    ("sent", "status", "reason"),
    [
        (b"HTTP/1.0 401 Unauthorized\r\n", 401, "Unauthorized"),  # str2str: no blank line
        (b"ICY 200 OK\r\n", 200, "OK"),  # str2str: nothing more before there is data
        (b"ERROR - Bad Password\r\n", 0, "ERROR - Bad Password"),
        (b"HTTP/1.1 404 Not Found\r\nServer: x\r\n\r\n", 404, "Not Found"),
    ],
)
def test_an_answer_is_known_from_its_first_line(sent: bytes, status: int, reason: str):
    reader, _ = read([sent])
    assert reader.known is not None
    assert (reader.known.status, reader.known.reason) == (status, reason)


@pytest.mark.parametrize("sent", [b"SSH-2.0-OpenSSH_9.2\r\n", b"\xb5\x62\x01", b"220 mail ready\r\n"])
def test_what_is_no_caster_is_said(sent: bytes):
    assert "no NTRIP caster" in read([sent])[0].fault


def test_requests():
    assert stream_request(ADDRESS, 1).startswith(b"GET /MOUNT HTTP/1.0\r\nUser-Agent: NTRIP ")
    assert b"Authorization: Basic bWU6cGFzcw==\r\n" in stream_request(ADDRESS, 1)
    second = stream_request(ADDRESS, 2, gga_sentence(Place(52.5, 13.4, 80.0), 0.0))
    assert second.startswith(b"GET /MOUNT HTTP/1.1\r\nHost: caster.example:2101\r\nNtrip-Version: Ntrip/2.0\r\n")
    assert b"\r\nNtrip-GGA: $GPGGA,000000.00,5230.0000000,N,01324.0000000,E,1,10,1.0,80.000,M,0.000,M,,*" in second
    assert second.endswith(b"Connection: close\r\n\r\n")
    assert push_request(ADDRESS, 1, "a;b").startswith(b"SOURCE pass /MOUNT\r\nSource-Agent: NTRIP ")
    assert push_request(ADDRESS, 2).startswith(b"POST /MOUNT HTTP/1.1\r\n")
    assert b"Authorization" not in stream_request(replace(ADDRESS, user="", password=""), 2)


@pytest.mark.parametrize(
    ("text", "user", "password", "host", "port", "mount"),
    [
        ("ntrip://caster.example/M", "", "", "caster.example", 2101, "M"),
        ("ntrips://caster.example/M", "", "", "caster.example", 443, "M"),
        ("ntrip://me:p@ss/w?rd#%41:x@caster:80/M_1?gga=on", "me", "p@ss/w?rd#%41:x", "caster", 80, "M_1"),
        ("ntrip://me@mail.example:none@rtk.example:2101/M", "me@mail.example", "none", "rtk.example", 2101, "M"),
        ("ntrip://[::1]:2101/M", "", "", "::1", 2101, "M"),
        ("ntrip://caster:2101?nearest", "", "", "caster", 2101, ""),
    ],
)
def test_addresses(text: str, user: str, password: str, host: str, port: int, mount: str):
    """User and password are taken as they are: what an environment variable holds needs no quoting."""
    address, _ = parse_caster(text)
    assert (address.user, address.password, address.host, address.port, address.mount) == (user, password, host, port, mount)
    assert not password or password not in str(address) + repr(address) + shown_url(text)


@pytest.mark.parametrize(
    "text", ["ntrip://", "ntrip://me:secret@", "ntrip://me:secret@host:99999/M", "ntrip://host:x/M", "ntrip://me:secret@h/Mä"]
)
def test_wrong_addresses_are_named_without_the_password(text: str):
    with pytest.raises(SourceError) as raised:
        parse_caster(text)
    assert "secret" not in str(raised.value)


@given(st.sampled_from([b"GET / HTTP/1.0\r\n", b"GET /M HTTP/1.1\r\nAuthorization: Basic ", b""]), st.binary(max_size=300))
def test_any_request_is_read_without_raising(beginning: bytes, rest: bytes):
    for data in (beginning + rest, beginning + rest + b"\r\n\r\n"):
        request = parse_request(data)
        assert request is None or isinstance(is_allowed(request, {"u": "p"}), bool)


@given(st.text(max_size=60), st.sampled_from([200, 302, 401, 404, 429, 503, 999]))
def test_any_refusal_is_said(text: str, status: int):
    dates = (
        text,
        f"Mon, 01 Jan {text} 00:00:00 GMT",
        "Fri, 31 Dec 9999 23:59:59 -2359",
        "Mon, 01 Jan 0001 00:00:00 +2359",
        "99999999999999",
    )
    for date in dates:
        error = refused(ADDRESS, Answer("HTTP/1.1", status, text, {"retry-after": date, "location": text}))
        assert 0.0 <= error.wait_s <= 3600.0


TABLE = (
    b"SOURCETABLE 200 OK\r\n"
    b"CAS;caster.example;2101;Example;x;0;DEU;0;0\r\n"
    b"STR;NEAR;Berlin;RTCM 3.2;1005(10),1077(1);2;GPS+GLO;X;DEU;52.50;13.40;0;0;x;none;B;N;4800;\r\n"
    b"STR;EAST;Fiji;RTCM 3;;2;GPS;X;FJI;-17.7;538.0;0;0\r\n"
    b"STR;WRAP;Alaska;RTCM3.3;;2;GPS;X;USA;61.2;210.1;1;0;x;none;B;N;x;\r\n"
    b"STR;OLD;Berlin too;RTCM 2.3;;2;GPS;X;DEU;52.50;13.40;0;0\r\n"
    b"STR;VRS;Network;RTCM 3.1;;2;GPS;X;DEU;52.50;13.40;1;1;x;none;B;N;4800;\r\n"
    b"STR;\r\nSTR\r\nNET;X;y\r\nENDSOURCETABLE\r\n"
    b"STR;UML\xe4UT;x\r\n"
)


def test_a_source_table_is_read_as_far_as_it_makes_sense():
    rows = {row.name: row for row in parse_table(TABLE)}
    assert list(rows) == ["NEAR", "EAST", "WRAP", "OLD", "VRS", "UMLäUT"]
    near = rows["NEAR"]
    assert (near.identifier, near.format, near.details, near.carrier, near.bitrate) == ("Berlin", "RTCM 3.2", "1005(10),1077(1)", 2, 4800)
    assert rows["WRAP"].lon_deg == pytest.approx(-149.9)
    assert isnan(rows["EAST"].lat_deg), "538 degrees are no longitude"
    assert (rows["WRAP"].needs_gga, rows["VRS"].is_network) == (True, True)


def test_the_nearest_mount_point_has_rtcm_3_of_a_real_station():
    rows = parse_table(TABLE)
    assert (best := nearest_mount(rows, 52.4, 13.1)) is not None
    assert best.name == "NEAR"
    assert best.distance_km(52.4, 13.1) == pytest.approx(23.2, abs=0.2)
    assert (best := nearest_mount(rows, 60.0, -150.0)) is not None
    assert best.name == "WRAP"
    assert nearest_mount([], 0.0, 0.0) is None
    assert nearest_names("near1", rows) == "; did you mean 'NEAR'?"


@given(st.binary(max_size=2000))
def test_any_table_is_read_without_raising(content: bytes):
    parse_table(content + b"\r\nSTR;" + content)


def test_a_row_of_ours_reads_back():
    mount = MountPoint(
        "BASE", "my; base", "RTCM 3.3", "1077(1)", 2, "GPS+GAL", lat_deg=52.5, lon_deg=13.4, bitrate=9600, authentication="B"
    )
    [back] = parse_table(table_row(mount).encode())
    assert back == replace(mount, identifier="my, base")


@given(st.floats(-90, 90), st.floats(-180, 180))
def test_positions_are_sentences_that_a_decoder_understands(lat_deg: float, lon_deg: float):
    sentence = gga_sentence(Place(lat_deg, lon_deg, 12.0), 1.7e9 + 0.999)
    body, _, check = sentence[1:].strip().partition("*")
    total = 0
    for byte in body.encode():
        total ^= byte
    assert int(check, 16) == total
    field = body.split(",")
    angles = [int(text[:-10]) + float(text[-10:]) / 60.0 for text in (field[2], field[4])]
    assert angles == pytest.approx([abs(lat_deg), abs(lon_deg)], abs=1e-8)
    assert all(float(text[-10:]) < 60.0 for text in (field[2], field[4]))
    assert (field[3], field[5]) == ("N" if lat_deg >= 0 else "S", "E" if lon_deg >= 0 else "W")
