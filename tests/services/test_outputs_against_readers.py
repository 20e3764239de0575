"""Whoever reads RTKRCV's streams reads ours: RTKLIB's own reader (pyrtklib5), str2str as TCP and NTRIP client, gpsd, pynmeagps."""

import json
import shutil
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from itertools import product
from pathlib import Path
from typing import Any

import pynmeagps
import pytest
from tests.patience import PATIENCE_S
from tests.services.text_world import HEIGHT_M, LAT_DEG, LON_DEG, TOW_S, WEEK, TextWorld, ecef_m, satellites, solution

from rtkmesh_schemas.config import OutputTable
from rtkmesh_services.runtime.clock import ManualClock
from rtkmesh_services.texts.geoid import geoid_height_m

COUNT = 20
STATUS = [1, 2, 4, 5]
TRACK = [solution(number, status=STATUS[number % 4]) for number in range(COUNT)]


def table(target: str, **options: object) -> OutputTable:
    return OutputTable(target=target, solver="rtk", single=True, **options)  # type: ignore[arg-type]


def written(path: Path, **options: object) -> Path:
    with TextWorld(ManualClock(), out=table(f"file://{path}", **options)) as world:
        world.solve(*TRACK)
    return path


# --- RTKLIB's reader of solutions, which RTKPLOT and pos2kml use

FORMS = [
    {"format": form, "time_form": time_form, "time_system": system, "separator": separator, **more}
    for (form, more), (time_form, system), separator in product(
        [("llh", {}), ("llh", {"angles": "dms"}), ("llh", {"velocity": True}), ("xyz", {}), ("xyz", {"velocity": True}), ("enu", {})],
        [("hms", "gpst"), ("tow", "gpst"), ("hms", "utc"), ("hms", "jst")],
        [" ", ","],
    )
    if (more, separator) != ({"angles": "dms"}, ",")  # what RTKLIB writes so, it does not read itself
]


@pytest.mark.parametrize("options", FORMS, ids=lambda options: "-".join(map(str, options.values())))
def test_rtklib_reads_our_files(tmp_path: Path, options: dict[str, Any]) -> None:
    """Times, positions, Q, ns, ages and ratios of every epoch."""
    rtklib: Any = pytest.importorskip("pyrtklib5", reason="pyrtklib5 has wheels for x86-64 only")
    path = written(tmp_path / "out.pos", dialect="2.4" if options["time_form"] == "tow" else "demo5", **options)
    buffer = rtklib.solbuf_t()
    rtklib.initsolbuf(buffer, 0, 0)
    assert rtklib.readsol([str(path)], 1, buffer) == 1
    assert buffer.n == COUNT
    for number, sent in enumerate(TRACK):
        read = buffer.data[number]
        week = rtklib.Arr1Dint(1)
        assert rtklib.time2gpst(read.time, week) == pytest.approx(TOW_S + 0.2 * number, abs=1e-3)
        assert week[0] == WEEK
        assert (read.stat, read.ns) == (sent.status, sent.satellites_used)
        assert (read.age, read.ratio) == (pytest.approx(sent.age_s, abs=0.01), pytest.approx(sent.ratio, abs=0.1))
        if options["format"] != "enu":
            assert [read.rr[axis] for axis in range(3)] == pytest.approx(sent.position_ecef_m, abs=2e-3)
    rtklib.freesolbuf(buffer)


def test_rtklib_reads_our_sentences_and_status_records(tmp_path: Path) -> None:
    """RMC and GGA as solutions, $SAT as residuals."""
    rtklib: Any = pytest.importorskip("pyrtklib5", reason="pyrtklib5 has wheels for x86-64 only")
    buffer = rtklib.solbuf_t()
    rtklib.initsolbuf(buffer, 0, 0)
    path = written(tmp_path / "out.nmea", format="nmea", nmea_satellites_interval_s=-1.0)
    assert rtklib.readsol([str(path)], 1, buffer) == 1
    assert buffer.n == COUNT
    last = buffer.data[COUNT - 1]
    assert [last.rr[axis] for axis in range(3)] == pytest.approx(TRACK[-1].position_ecef_m, abs=0.02)
    rtklib.freesolbuf(buffer)
    path = tmp_path / "out.stat"
    with TextWorld(ManualClock(), out=table(f"file://{path}", format="stat", status_level="residual")) as world:
        for number, one in enumerate(TRACK):
            world.solve(one)
            world.see(satellites(number))
    records = rtklib.solstatbuf_t()
    assert rtklib.readsolstat([str(path)], 1, records) == 1
    assert records.n == 3 * COUNT


# --- str2str takes the stream and hands it on, to the byte


@contextmanager
def running(*command: str) -> Iterator[None]:
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield
    finally:
        process.terminate()
        process.wait(10.0)


@pytest.mark.rtklib
@pytest.mark.parametrize("form", ["llh", "nmea", "stat"])
def test_str2str_relays_equal_bytes_from_our_servers(
    rtklib_program: Callable[[str], str], tmp_path: Path, free_port: Callable[[], int], form: str
) -> None:
    """From the TCP server and from the caster; the file of a third output has the same."""
    tcp, ntrip, str2str = free_port(), free_port(), rtklib_program("str2str")
    options: dict[str, Any] = {"format": form}
    outs = {
        "out": table(f"file://{tmp_path}/sent", **options),
        "tcp": table(f"tcp-listen://127.0.0.1:{tcp}", **options),
        "caster": table(f"ntrip-caster://127.0.0.1:{ntrip}/POS", users={"me": "pw"}, **options),
    }
    with ExitStack() as stack:  # by the clock of the test no epoch waits too long for its satellites, in one output and not in another
        world = stack.enter_context(TextWorld(ManualClock(), **outs))
        world.until(lambda: all(world.status(name).inputs[1].state == "listening" for name in ("tcp", "caster")))  # str2str asks every 10 s
        stack.enter_context(running(str2str, "-in", f"tcpcli://127.0.0.1:{tcp}", "-out", f"file://{tmp_path}/tcp"))
        stack.enter_context(running(str2str, "-in", f"ntrip://me:pw@127.0.0.1:{ntrip}/POS", "-out", f"file://{tmp_path}/ntrip"))
        world.until(lambda: len(world.status("tcp").inputs) == 3 and len(world.status("caster").inputs) == 3)
        for number, one in enumerate(TRACK):
            world.solve(one)
            world.see(satellites(number))
        world.until(lambda: (tmp_path / "sent").stat().st_size == world.status("out").inputs[-1].bytes)
        sent = (tmp_path / "sent").read_bytes()
        assert len(sent) > 1000
        for name in ("tcp", "ntrip"):
            relayed = tmp_path / name
            world.until(lambda relayed=relayed: relayed.exists() and relayed.read_bytes().endswith(sent[-200:]))
    for name in ("tcp", "ntrip"):
        assert (tmp_path / name).read_bytes().removeprefix(b"\r\n") == sent


# --- readers of sentences


def test_pynmeagps_reads_every_sentence(tmp_path: Path) -> None:
    """Checksums, fields and values by an independent parser."""
    path = written(tmp_path / "out.nmea", format="nmea", talker="GN")
    with path.open("rb") as stream:
        messages = [parsed for _, parsed in pynmeagps.NMEAReader(stream, validate=pynmeagps.VALCKSUM, quitonerror=pynmeagps.ERR_RAISE)]
    positions = [message for message in messages if message.msgID == "GGA"]
    assert {message.msgID for message in messages} >= {"GGA", "RMC", "GST"}
    assert len(positions) == COUNT
    for number, message in enumerate(positions):
        assert message.lat == pytest.approx(LAT_DEG + number * 1e-6, abs=1e-8)
        assert message.lon == pytest.approx(LON_DEG, abs=1e-8)
        assert message.alt + message.sep == pytest.approx(HEIGHT_M, abs=2e-3)
        assert message.quality == {1: 4, 2: 5, 4: 2, 5: 1}[STATUS[number % 4]]
    assert geoid_height_m(0.0, 0.0) == pytest.approx(17.16, abs=0.1)


def test_gpsd_reads_our_tcp_server(free_port: Callable[[], int]) -> None:
    """The real daemon: a 3D fix at our place and time, and the satellites."""
    gpsd = shutil.which("gpsd")
    if gpsd is None:
        pytest.skip("no gpsd (Debian package gpsd)")
    ours, theirs = free_port(), free_port()
    with ExitStack() as stack:
        world = stack.enter_context(TextWorld(out=table(f"tcp-listen://127.0.0.1:{ours}", format="nmea")))
        world.until(lambda: world.status().inputs[1].state == "listening")
        stack.enter_context(running(gpsd, "-N", "-n", "-b", "-S", str(theirs), f"tcp://127.0.0.1:{ours}"))
        world.until(lambda: len(world.status().inputs) == 3)
        with watching(theirs) as reports:
            fixes: list[dict[str, Any]] = []
            number = 0
            while len(fixes) < 5:
                world.solve(solution(number))
                world.see(satellites(number))
                fixes += [report for report in reports() if report["class"] == "TPV" and report.get("mode") == 3]
                number += 1
                assert number < 2000
    fix = fixes[-1]
    assert (fix["lat"], fix["lon"]) == (pytest.approx(LAT_DEG, abs=3e-3), pytest.approx(LON_DEG, abs=1e-7))
    assert fix["altHAE"] == pytest.approx(HEIGHT_M, abs=0.01)
    assert fix["time"].startswith("2025-10-")
    assert ecef_m(fix["lat"], fix["lon"], fix["altHAE"])[2] == pytest.approx(TRACK[0].position_ecef_m[2], abs=300.0)


@contextmanager
def watching(port: int) -> Iterator[Callable[[], list[dict[str, Any]]]]:
    """A client of gpsd: a function that returns its reports since the last call."""
    deadline_s = time.monotonic() + PATIENCE_S
    while True:
        try:
            connection = socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S)
            break
        except ConnectionRefusedError:
            assert time.monotonic() < deadline_s
            time.sleep(0.02)
    with connection:
        connection.sendall(b'?WATCH={"enable":true,"json":true}\n')
        connection.settimeout(0.02)
        rest = b""

        def reports() -> list[dict[str, Any]]:
            nonlocal rest
            try:
                rest += connection.recv(65536)
            except TimeoutError:
                return []
            *whole, rest = rest.split(b"\n")
            return [json.loads(line) for line in whole if line.strip()]

        yield reports
