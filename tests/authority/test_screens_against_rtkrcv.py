"""Screens of a solver's words beside those of rtkrcv 2.4.3 b34 on a terminal, which reads the same simulated receivers from files."""

import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
import pytest
from tests.authority.rtkrcv_console import RtkrcvConsole

from rtkmesh.codecs.stream import StreamDecoder, StreamOptions
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.options import RtkOptions
from rtkmesh.rtk.session import EndOfStream, Session, SessionOptions, Source, pairing_for
from rtkmesh.simulation.scenario import open_stream, truth
from rtkmesh_schemas.config import Deployment, IngestTable, SolverTable
from rtkmesh_services.mapping.solution import solution_message
from rtkmesh_services.runtime.service import Report
from rtkmesh_services.solver.inputs import InputStream
from rtkmesh_services.solver.neighbours import Neighbours
from rtkmesh_services.solver.screens.navigation import navigation_screen
from rtkmesh_services.solver.screens.satellites import observations_screen, satellites_screen
from rtkmesh_services.solver.screens.solutions import SolutionForm, solution_line
from rtkmesh_services.solver.screens.status import StatusView, status_screen
from rtkmesh_services.solver.screens.streams import stream_rows, streams_screen

pytestmark = pytest.mark.rtklib
START = GpsTime(2445, 529200.0)
EPOCHS = 20
SECONDS = re.compile(r"obs\((\d+)\)")


@dataclass
class Both:
    """rtkrcv after all epochs, and our session after the same."""

    console: RtkrcvConsole
    session: Session
    epochs: dict[int, dict[str, Epoch]]
    solutions: list[object]


@pytest.fixture(scope="module")
def both(rtklib_program: Callable[[str], str], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Both]:
    folder = tmp_path_factory.mktemp("rtkrcv")
    options = RtkOptions(systems="GREJC")
    session = Session(SessionOptions(options, pairing_for(options, replay=True), base_position_ecef_m=BASE_ECEF_M))
    epochs: dict[int, dict[str, Epoch]] = {}
    for number, (source, antenna) in enumerate(((Source.ROVER, "rover"), (Source.BASE, "heading")), 1):
        data = b"".join(epoch.data for epoch in islice(open_stream("static", antenna, seed=1, rate_hz=1.0, start=START).epochs(), EPOCHS))
        (folder / f"{number}.ubx").write_bytes(data)
        decoder = StreamDecoder(StreamOptions(approximate_time=START))
        messages = [m for _, found in decoder.feed(data) for m in found] + decoder.flush()
        epochs[number] = {shown_time(m): as_taken(m) for m in messages if isinstance(m, Epoch)}
        for message in [*messages, EndOfStream()]:
            session.feed(source, message)
    inputs = {
        f"inpstr{number}-{name}": value
        for number in (1, 2)
        for name, value in (("type", "file"), ("path", str(folder / f"{number}.ubx")), ("format", "ubx"))
    }
    position = {f"ant2-pos{k + 1}": f"{value:.4f}" for k, value in enumerate(BASE_ECEF_M)}
    fixed = {"pos1-posmode": "kinematic", "pos1-frequency": "l1+2", "pos1-navsys": "61", "ant2-postype": "xyz", "pos2-armode": "continuous"}
    console = RtkrcvConsole(rtklib_program("rtkrcv"), folder, {**inputs, **fixed, **position})
    console.ask("start")
    until_read(console)
    yield Both(console, session, epochs, list(session.solutions()))
    console.close()


def as_taken(epoch: Epoch) -> Epoch:
    """An epoch without the phases that the receiver calls worse than 0.02 cycles: RTKLIB takes none of them (ublox.c, CPSTD_VALID)."""
    return replace(epoch, phase_cyc=np.where(epoch.phase_sigma_cyc > 0.0201, np.nan, epoch.phase_cyc))


def until_read(console: RtkrcvConsole) -> None:
    """Wait until it has read its files and solved what it takes of them."""
    deadline, told = time.monotonic() + 30.0, [""]
    while min([int(count) for count in SECONDS.findall(told[-1])[:2]] or [0]) < EPOCHS or told[-1] != told[-2]:
        assert time.monotonic() < deadline, "rtkrcv did not read its files"
        told.append(re.sub(r"(run|cycle \(ms\)) *:.*", "", console.ask("status")))


BASE_ECEF_M = tuple(truth("static", seed=1)(START).antennas_ecef_m["heading"].tolist())


def shown_time(epoch: Epoch) -> str:
    """An epoch by the second, as both programs print it."""
    calendar = (epoch.time + 0.005).to_calendar()
    return f"{calendar:%Y/%m/%d %H:%M:%S}"


def view(both: Both) -> StatusView:
    deployment = Deployment(ingest={name: IngestTable(source="tcp://h:1") for name in ("rover", "base")}, solver={"rtk": TABLE})
    return StatusView(
        inputs={name: InputStream(name, source, replay=False) for name, source in (("rover", Source.ROVER), ("base", Source.BASE))},
        counters=Report().counters, table=TABLE, running=True, ran_s=3725.25, cycle_ms=100.0, solve_ms=1.0, solution=both.solutions[-1],
        interval_s=1.0, overview=both.session.engine.overview(), neighbours=Neighbours(deployment, "rtk"), antennas={},
    )  # fmt: skip


TABLE = SolverTable(rover="rover", base="base")


def test_status_has_rtkrcvs_parameters_in_its_order(both: Both) -> None:
    ours, theirs = status_screen(view(both)).splitlines(), both.console.ask("status").splitlines()
    assert [line.partition(":")[0] for line in ours] == [line.partition(":")[0] for line in theirs]
    told = {line[:28].strip(): (mine[30:], line[30:]) for mine, line in zip(ours, theirs, strict=True)}
    for name in ("rtk server state", "positioning mode", "solution interval (s)", "pos xyz (m) base"):
        assert told[name][0] == told[name][1], name
    for name, limit in (("pos xyz single (m) rover", 5.0), ("vel enu (m/s) rover", 0.5), ("GDOP/PDOP/HDOP/VDOP", 0.4)):
        mine, other = ([float(value) for value in text.split(",")] for text in told[name])
        assert np.abs(np.subtract(mine, other)).max() < limit, name
    assert told["accumulated time to run"][0] == "01:02:05.2"
    assert [len(text) for text in told["time of receiver clock rover"]] == [29, 29]
    assert abs(float(told["baseline length fixed (m)"][0]) - 1.0) < 0.02


@pytest.mark.parametrize("count", [1, 2, 3])
def test_observations_are_rtkrcvs_to_the_digit(both: Both, count: int) -> None:
    """Of the epoch that it happens to show; second bands differ where it prefers another code of a satellite."""
    theirs = both.console.ask(f"observ -{count}").splitlines()
    shown = {number: [line for line in theirs[1:] if line[27] == str(number)] for number in (1, 2)}
    for number, lines in shown.items():
        epoch = next(epoch for second, epoch in both.epochs[number].items() if near(lines[0], second))
        head, *rows = observations_screen({number: epoch}, count).splitlines()
        assert head == theirs[0]
        known = {row[23:26]: row for row in rows}
        assert set(known) == {line[23:26] for line in lines}
        for line in lines:
            mine, ends = known[line[23:26]], [41 + 13 * count, 55 + 13 * count]
            assert len(mine) == len(line) or "128" in line, "its LLI has bits of its own"
            assert mine[23:41] == line[23:41]
            assert mine[ends[0] - 13 : ends[1] - 14] == line[ends[0] - 13 : ends[1] - 14] or count > 1
        same = sum(known[line[23:26]][23 : 28 + 35 * count] == line[23 : 28 + 35 * count] for line in lines)
        assert same >= (len(lines) if count == 1 else len(lines) // 3)


def near(line: str, time_: str) -> bool:
    """Whether a line of rtkrcv, which cuts decimals off, is of the epoch of this second."""
    day, clock = line[:19].split()
    shown = GpsTime.from_calendar(*map(int, day.split("/")), *map(int, clock.split(":"))) + float(line[19:22]) + 0.01
    return shown_time_of(shown) == time_


def shown_time_of(time_: GpsTime) -> str:
    return f"{(time_ + 0.005).to_calendar():%Y/%m/%d %H:%M:%S}"


def test_ephemerides_are_rtkrcvs(both: Both) -> None:
    """All but the times of transmission (we keep the first one of an issue) and L2 flags."""
    now = both.solutions[-1].time
    ours = navigation_screen(*both.session.table.newest(), now, both.session.klobuchar).splitlines()
    theirs = both.console.ask("navidata").splitlines()
    assert ours[0] == theirs[0]
    known = {line[:3]: line for line in ours}
    checked = 0
    for line in theirs[1:]:
        if line[:3] not in ("ION", "UTC") and line[5:7] == "OK" and line[0] in "GRJ":
            assert known[line[:3]][:11] == line[:11]
            assert known[line[:3]][16:19] == line[16:19]
            first = 23 if line[0] == "R" else 20  # it reads no accuracy of GLONASS
            assert known[line[:3]][first:67] == line[first:67]
            checked += 1
    assert checked > 10
    assert [line for line in ours if line.startswith("ION")] == [line for line in theirs if line.startswith("ION")]


@pytest.mark.parametrize("count", [1, 2, 3])
def test_satellites_have_rtkrcvs_columns(both: Both, count: int) -> None:
    ours = satellites_screen(both.solutions[-1], both.session.engine.overview(), count, holds=False).splitlines()
    theirs = both.console.ask(f"satellite -{count}").splitlines()
    assert ours[0] == theirs[0]
    mine = {line[:3]: line for line in ours[1:]}
    assert {len(line) for line in ours} >= {len(line) for line in theirs[1:]}
    common = [line for line in theirs[1:] if line[:3] in mine]
    assert len(common) > 15
    for line in common:
        angles = [[float(row[6:12]), float(row[12:17])] for row in (mine[line[:3]], line)]
        assert np.abs(np.subtract(*angles)).max() < 0.3, line
        assert len(mine[line[:3]].split()) == len(line.split())


def test_streams_have_rtkrcvs_rows(both: Both) -> None:
    deployment = Deployment(ingest={name: IngestTable(source="tcp://h:1") for name in ("rover", "base")}, solver={"rtk": TABLE})
    ours = streams_screen(stream_rows(TABLE, deployment, Neighbours(deployment, "rtk"))).splitlines()
    theirs = both.console.ask("stream").splitlines()
    assert ours[0] == theirs[0]
    assert [line[:12] for line in ours] == [line[:12] for line in theirs]
    assert ours[6:] == theirs[6:]


@pytest.mark.parametrize("coordinates", ["dms", "deg", "xyz", "enu", "pyl"])
@pytest.mark.parametrize("time_form", ["gpst", "utc", "jst", "tow"])
def test_solutions_are_laid_out_as_rtkrcvs(both: Both, coordinates: str, time_form: str) -> None:
    """Every number stands in rtkrcv's columns, and is its number to what two engines agree."""
    for name, value in (("soltype", coordinates), ("timetype", time_form), ("solflag", "3")):
        both.console.ask(f"set console-{name} {value}")
    both.console.ask("restart")
    until_read(both.console)
    line = next(row for row in reversed(both.console.ask("solution").splitlines()) if "------" not in row)
    by_time = {}
    for solution in both.solutions:
        message = solution_message(
            solution, source="rtk", start_id="x", sequence=0, mode="kinematic", rover="rover", base="base", solve_ms=0.0
        )
        mine = solution_line(message, SolutionForm(coordinates, time_form, 3))
        by_time[mine.partition("(")[0]] = mine
    mine = by_time[line.partition("(")[0]]
    assert shape(mine) == shape(line)


def shape(line: str) -> str:
    """A line with the width of each number in its place; numbers that are wider than their column do not count."""
    plain = re.sub(r"\((FIX|FLOAT|SINGLE|DGPS) *\)", "(------)", line)
    plain = re.sub(r"A:.* R:", "A: R:", plain)
    return re.sub(r"([A-Z]):([-+ \d.]*\d)", lambda match: f"{match[1]}:{len(match[2])}", plain)
