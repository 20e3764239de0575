"""What a base station knows of its position: saved files, means with honest sigmas, moves, and the languages of receivers."""

import gzip
import json
import math
import threading
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyubx2 import SET, UBXReader

from rtkmesh.codecs.framing import Framer
from rtkmesh.codecs.messages import Frame, Protocol
from rtkmesh.codecs.rtcm3_station import StationDecoder
from rtkmesh.gnss.ephemeris import ReceiverFix, ReferenceStation
from rtkmesh.gnss.frames import ecef_from_geodetic, enu_from_ecef_at, geodetic_from_ecef
from rtkmesh_schemas.command import Code
from rtkmesh_schemas.config import BaseStationTable, Deployment
from rtkmesh_schemas.keys import EVENT, Role
from rtkmesh_schemas.status import Event
from rtkmesh_schemas.wire import decode
from rtkmesh_services.errors import CommandError, ServiceError
from rtkmesh_services.ingest.base.averaging import CODE, FIXED, PositionAverage, mean_factor
from rtkmesh_services.ingest.base.found import Found
from rtkmesh_services.ingest.base.presets import HISTORY, PresetStore
from rtkmesh_services.ingest.base.station import BaseStation
from rtkmesh_services.ingest.base.watch import PositionWatch, code_limit_m
from rtkmesh_services.ingest.receivers.orders import Answer, Conversation, Order, TextLines
from rtkmesh_services.ingest.receivers.survey import Dialect
from rtkmesh_services.ingest.receivers.text_receivers import dialect_of, septentrio, unicore
from rtkmesh_services.ingest.receivers.ublox import centimetres, progress_of
from rtkmesh_services.ingest.ubx_commands import framed
from rtkmesh_services.runtime.memory_bus import MemoryBus, MemoryNetwork
from rtkmesh_services.runtime.service import Context

PLACE = (4268987.123, 1178894.456, 4574798.789)


def position(name: str = "roof", x_m: float = 0.0):
    found = Found((PLACE[0] + x_m, PLACE[1], PLACE[2]), 0.4, "survey-in", 60.0, 60)
    return found.saved_as(name, 1_767_225_600_000_000_000, "test", ReferenceStation(7, antenna="AOAD/M_T"), datum="ETRS89")


def test_a_saved_position_is_read_back_with_all_that_is_known_of_it(tmp_path: Path):
    store = PresetStore(tmp_path)
    assert store.get("roof") is None
    assert store.save(position()) is None
    found = PresetStore(tmp_path).get("roof")
    assert found == position()
    assert (found.datum, found.saved_utc, found.antenna) == ("ETRS89", "2026-01-01T00:00:00Z", "AOAD/M_T")
    assert [path.name for path in tmp_path.iterdir() if path.suffix != ".lock"] == ["base_positions.json"]


def test_nothing_is_replaced_unless_asked_for_and_nothing_is_lost(tmp_path: Path):
    store = PresetStore(tmp_path)
    store.save(position())
    with pytest.raises(CommandError, match="there is a position 'roof' of 2026-01-01T00:00:00Z; say replace"):
        store.save(position(x_m=5.0))
    assert store.get("roof") == position()
    assert store.save(position(x_m=5.0), replace=True) == position()
    assert store.forget("roof") == position(x_m=5.0)
    assert store.get("roof") is None
    assert store.all()["roof"].history == [position(x_m=5.0), position()]
    with pytest.raises(CommandError) as raised:
        store.forget("roof")
    assert raised.value.code is Code.BAD_ARGUMENTS
    for number in range(HISTORY + 5):
        store.save(position(x_m=float(number)), replace=True)
    assert len(store.all()["roof"].history) == HISTORY


@pytest.mark.parametrize("text", ["{", "[]", '{"version": 2}', '{"presets": {"roof": {"current": {"name": 1}}}}', "\x00\xff"])
def test_a_file_that_is_none_is_named_and_left_alone(tmp_path: Path, text: str):
    file = tmp_path / "base_positions.json"
    file.write_text(text)
    for use in (lambda store: store.get("roof"), lambda store: store.save(position())):
        with pytest.raises(ServiceError, match=r"base_positions\.json: "):
            use(PresetStore(tmp_path))
    assert file.read_text() == text


def test_several_processes_save_at_once(tmp_path: Path):
    """Each opens the lock for itself, as processes do: no save is lost."""
    names = [f"roof{number}" for number in range(24)]
    threads = [threading.Thread(target=lambda name=name: PresetStore(tmp_path).save(position(name))) for name in names]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(PresetStore(tmp_path).all()) == sorted(names)
    json.loads((tmp_path / "base_positions.json").read_text())


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ServiceError, match="file"):
        PresetStore(tmp_path / "file" / "below").save(position())


def fix(enu_m: np.ndarray, kind: int = 3, sigma_m: float = 1.0) -> ReceiverFix:
    place = np.array(PLACE)
    lat_rad, lon_rad, height_m = geodetic_from_ecef(place + enu_from_ecef_at(place).T @ enu_m).tolist()
    return ReceiverFix(None, kind, lat_rad, lon_rad, height_m, sigma_m, 1.5 * sigma_m, None, 12)


def test_the_factor_of_a_mean_is_that_of_its_integral():
    """Against the sum of the autocovariance of a sampled Gauss-Markov process."""
    for duration_s in (1.0, 60.0, 1800.0, 7200.0, 86400.0):
        n = 2000
        lags = np.arange(n) * duration_s / n
        weights = 2.0 * (1.0 - np.arange(n) / n)
        weights[0] = 1.0
        numeric = math.sqrt(np.sum(weights * np.exp(-lags / 1800.0)) / n)
        assert mean_factor(duration_s, 1800.0) == pytest.approx(numeric, rel=1e-3)
    assert mean_factor(0.0, 1800.0) == 1.0


def test_the_sigma_of_a_mean_is_honest_where_errors_last():
    """Many means of Gauss-Markov errors: what they err by is what the sigma says; a sigma of independent fixes would be ten times less."""
    random, steps, step_s = np.random.default_rng(4), 60, 120.0
    decay = math.exp(-step_s / CODE.correlation_s)
    single = np.array([CODE.horizontal_m, CODE.horizontal_m, CODE.vertical_m])
    errors, claimed = [], []
    for _ in range(40):
        average, error = PositionAverage(), single * random.standard_normal(3)
        for step in range(steps):
            error = decay * error + math.sqrt(1.0 - decay**2) * single * random.standard_normal(3)
            average.add(fix(error, sigma_m=0.5), step * step_s)
        mean = average.mean()
        assert mean is not None
        errors.append(enu_from_ecef_at(np.array(PLACE)) @ (np.array(mean.position_ecef_m) - np.array(PLACE)))
        claimed.append(mean.sigma_enu_m)
    ratio = np.sqrt(np.mean(np.square(errors), axis=0)) / np.mean(claimed, axis=0)
    assert np.all((ratio > 0.7) & (ratio < 1.3)), ratio


def test_outliers_do_not_move_the_mean():
    average = PositionAverage()
    random = np.random.default_rng(5)
    for second in range(200):
        error = np.array([80.0, -40.0, 10.0]) if second % 10 == 3 else 0.3 * random.standard_normal(3)
        average.add(fix(error), float(second))
    mean = average.mean()
    assert mean is not None
    assert np.linalg.norm(np.array(mean.position_ecef_m) - np.array(PLACE)) < 0.1
    assert mean.observations == 200


def test_fixes_with_integers_are_preferred_and_those_without_three_dimensions_count_for_nothing():
    average = PositionAverage()
    for second in range(20):
        average.add(fix(np.array([2.0, 0.0, 0.0])), float(second))
        average.add(fix(np.array([0.01, 0.0, 0.0]), 6, 0.01), float(second))
        average.add(fix(np.array([900.0, 0.0, 0.0]), 2), float(second))
        average.add(fix(np.full(3, math.nan)), float(second))
    mean = average.mean()
    assert mean is not None
    assert mean.observations == 20
    assert mean.accuracy_m < 0.05
    assert FIXED.horizontal_m <= mean.sigma_enu_m[0] * 1.05


def test_a_long_average_stays_small():
    average = PositionAverage()
    for second in range(20000):
        average.add(ReceiverFix(None, 3, 0.8, 0.2, 100.0, 1.0, 1.0, None, 9), float(second))
    mean = average.mean()
    assert mean is not None
    assert (mean.observations, mean.duration_s) == (20000, 19999.0)
    assert len(average._series[CODE]._enu_m) <= 8192
    assert np.allclose(mean.position_ecef_m, ecef_from_geodetic(0.8, 0.2, 100.0), atol=1e-6)


def test_a_watch_believes_the_first_position_and_tells_each_move_once():
    watch = PositionWatch(0.1)
    east = enu_from_ecef_at(np.array(PLACE)).T @ np.array([1.0, 0.0, 0.0])

    def at(metres: float):
        x, y, z = (np.array(PLACE) + metres * east).tolist()
        return watch.sent((x, y, z))

    assert [at(0.0), at(0.05)] == [None, None]
    moved = at(0.3)
    assert moved is not None
    assert (moved.too_far, moved.distance_m) == (True, pytest.approx(0.3))
    assert str(moved).startswith("0.30 m from its first 1005/1006 (+0.30 m east, ")
    assert at(0.31) is None, "told already"
    assert at(0.6) is not None, "it goes on"
    back = at(0.0)
    assert back is not None
    assert not back.too_far
    assert watch.moved is None


def test_a_code_position_tells_no_centimetres():
    assert code_limit_m(0.01, 0.01, 0.1) == pytest.approx(7.5, abs=0.01)
    assert code_limit_m(3.0, 4.0, 0.1) == pytest.approx(15.0)
    assert code_limit_m(0.01, 0.01, 50.0) == 50.0


@given(st.floats(-7e6, 7e6))
def test_centimetres_and_tenths_of_millimetres_are_the_value(value_m: float):
    whole, rest = centimetres(value_m)
    assert abs(rest) <= 99
    assert whole * rest >= 0
    assert whole * 1e-2 + rest * 1e-4 == pytest.approx(value_m, abs=5.1e-5)


GOLDEN = {  # of a Skybrush server, which configures generation 8 (seed_systems.md 1.5)
    "survey": "b562067128000000010000000000000000000000000000000000000000001e00000088130000000000000000000059ca",
    "fixed": "b562067128000000020018f57119a5d90607c696441b1e3c5a00c80000000000000000000000000000000000",
}


def test_generation_8_is_told_as_skybrush_tells_it():
    legacy = dialect_of("ublox-legacy")
    assert legacy is not None
    assert legacy.survey(30.0, 0.5)[-1].data.hex() == GOLDEN["survey"]
    assert legacy.fixed(PLACE, 0.02)[0].data.hex().startswith(GOLDEN["fixed"][:76])


def test_generation_9_is_told_what_pyubx2_reads():
    ublox = dialect_of("ublox")
    assert ublox is not None
    survey = UBXReader.parse(ublox.survey(60.0, 1.0)[1].data, msgmode=SET)
    assert (survey.CFG_TMODE_MODE, survey.CFG_TMODE_SVIN_MIN_DUR, survey.CFG_TMODE_SVIN_ACC_LIMIT) == (1, 60, 10000)
    fixed = UBXReader.parse(ublox.fixed((-PLACE[0], PLACE[1], PLACE[2]), 0.02)[0].data, msgmode=SET)
    assert (fixed.CFG_TMODE_MODE, fixed.CFG_TMODE_ECEF_X, fixed.CFG_TMODE_ECEF_X_HP) == (2, -426898712, -30)
    assert fixed.CFG_TMODE_FIXED_POS_ACC == 200


@given(st.binary(max_size=60))
def test_any_nav_svin_is_read_or_not(payload: bytes):
    progress_of(Frame(Protocol.UBX, "01-3b", framed(1, 0x3B, payload)))


LINES = {  # what receivers are seen to say (UM980, UM982: also in the middle of other bytes; mosaic-X5)
    "unicore": [
        ("MODE BASE TIME 60", "$command,MODE BASE TIME 60,response: OK*7F", True),
        ("MODE BASE TIME 60", "x{\x20$command,mode base time 60,response: OK*00", True),
        ("MODE BASE TIME 60", "$command,MODE BASE TIME 6,response: OK*7F", None),
        ("MODE BASE TIME 6", "$command,MODE BASE TIME 60,response: OK*7F", None),
        ("MODE BASE TIME 60", "$command,response: PARSING FAILED NO MATCHING FUNC MODE BASE TIME 60*22", False),
        ("MODE BASE TIME 60", "$command,MODE BASE TIME 60,response: not support*22", False),
        ("MODE BASE TIME 60", "#MODE,97,GPS,FINE,2190,1,0,0,18,1;MODE BASE TIME 60*1B", None),
    ],
    "septentrio": [
        ("setPVTMode, Static, , auto", "$R: setPVTMode, Static, , auto", True),
        ("setPVTMode, Static, , auto", "COM1> $R: setPVTMode, Static, , auto", True),
        ("setPVTMode, Static, , auto", "$R? setPVTMode: Argument 'Mode' is invalid!", False),
        ("setPVTMode, Static, , auto", "$R: getReceiverCapabilities", None),
        ("setPVTMode, Static, , auto", "$R: setPVTMode, Rover", None),
    ],
}


@pytest.mark.parametrize(("language", "command", "line", "accepted"), [(kind, *row) for kind, rows in LINES.items() for row in rows])
def test_answers_in_words_are_judged(language: str, command: str, line: str, accepted: bool | None):
    order = {"unicore": unicore, "septentrio": septentrio}[language](command)
    assert order.data == f"{command}\r\n".encode()
    answer = order.judge(line)
    assert (None if answer is None else answer.accepted) is accepted


@pytest.mark.parametrize(
    ("receiver", "survey", "fixed"),
    [
        ("unicore", ["MODE BASE TIME 3600"], ["MODE BASE 4268987.1230 1178894.4560 4574798.7890"]),
        (
            "septentrio",
            ["setPVTMode, Rover", "setPVTMode, Static, , auto"],
            ["setStaticPosGeodetic, Geodetic1, 46.121", "setPVTMode, Static, , Geodetic1"],
        ),
    ],
)
def test_receivers_of_text_are_told_their_commands(receiver: str, survey: list[str], fixed: list[str]):
    dialect: Dialect | None = dialect_of(receiver)
    assert dialect is not None
    assert [order.said for order in dialect.survey(5000.0, 1.0)] == survey
    told = [order.said for order in dialect.fixed(PLACE, 0.02)]
    assert all(text.startswith(start) for text, start in zip(told, fixed, strict=True)), told
    if receiver == "septentrio":
        lat_deg, lon_deg, height_m = (float(part) for part in told[0].split(",")[2:])
        assert np.allclose(ecef_from_geodetic(math.radians(lat_deg), math.radians(lon_deg), height_m), PLACE, atol=2e-4)


def order(text: str, *, needed: bool = True) -> Order:
    return Order(
        text, text.encode(), lambda heard: Answer(heard == f"yes {text}", str(heard)) if str(heard).endswith(text) else None, needed
    )


class Line:
    def __init__(self) -> None:
        self.sent: list[tuple[float, bytes]] = []
        self.open = True
        self.now_s = 0.0

    def send(self, data: bytes) -> bool:
        if self.open:
            self.sent.append((self.now_s, data))
        return self.open

    def run(self, talk: Conversation, seconds: float) -> None:
        end_s = self.now_s + seconds
        while self.now_s < end_s and not talk.ended:
            talk.tick(self.now_s)
            self.now_s = round(self.now_s + 0.1, 3)


def test_an_order_is_said_again_with_growing_patience_and_then_given_up():
    line = Line()
    talk = Conversation([order("a"), order("b")], line.send)
    line.run(talk, 60.0)
    assert [time_s for time_s, _ in line.sent] == pytest.approx([0.0, 1.0, 3.0, 7.0], abs=0.11)
    assert talk.failure == "a: no answer after 4 attempts"


def test_the_next_order_follows_the_answer_at_once_and_a_refusal_ends_it():
    line = Line()
    talk = Conversation([order("a"), order("b"), order("c")], line.send)
    talk.tick(0.0)
    talk.hear("yes b", 0.1)
    talk.hear("yes a", 0.2)
    assert [data for _, data in line.sent] == [b"a", b"b"]
    talk.hear("no b", 0.3)
    assert talk.ended
    assert talk.failure == "b: refused (no b)"


def test_what_is_not_needed_stops_nothing_and_a_closed_line_counts_no_attempt():
    line = Line()
    line.open = False
    talk = Conversation([order("a", needed=False), order("b")], line.send)
    line.run(talk, 30.0)
    assert line.sent == []
    line.open = True
    talk.tick(line.now_s)
    talk.hear("no a", line.now_s)
    talk.hear("yes b", line.now_s)
    assert (talk.ended, talk.failure, len(talk.told)) == (True, "", 2)


@given(st.lists(st.binary(max_size=30)), st.binary(max_size=60))
def test_lines_are_found_however_the_stream_is_cut(pieces: list[bytes], junk: bytes):
    text = b"$command,MODE ROVER,response: OK*5D\r\n"
    data = junk.replace(b"\n", b"") + b"\xb5\x00" + text + b"".join(pieces)
    whole, cut = TextLines(), TextLines()
    found = [line for byte in data for line in cut.feed(bytes((byte,)))]
    assert found == whole.feed(data)
    assert "$command,MODE ROVER,response: OK*5D" in found


def frames_of(file: Path) -> list[Frame]:
    return Framer().feed(gzip.decompress(file.read_bytes()))


SURVEYS = {  # of an M8P near Galway: seconds, accuracy (m) and position that it ended with
    "base-20181004-1236": (128.0, 1.3375, (3774089.2120, -601661.6157, 5089321.2475)),
    "base-20181004-1452": (128.0, 1.6935, (3774085.6456, -601662.5770, 5089316.3970)),
    "base-20181015-1654": (2554.0, 1.0000, (3774701.7853, -596672.9250, 5089485.8556)),
}


@pytest.mark.data
@pytest.mark.parametrize("name", SURVEYS)
def test_real_surveys_are_read_as_pyubx2_reads_them_and_end_at_the_1005_that_follows(data: Path, name: str):
    [file] = data.rglob(f"{name}.ubx.gz")
    frames = frames_of(file)
    said = [frame for frame in frames if frame.kind == "01-3b"]
    for frame in said[::20]:
        progress, other = progress_of(frame), UBXReader.parse(frame.data)
        assert progress is not None
        assert (progress.duration_s, progress.observations) == (other.dur, other.obs)
        assert (progress.valid, progress.active) == (bool(other.valid), bool(other.active))
        assert progress.accuracy_m == pytest.approx(other.meanAcc * 1e-4)
        assert progress.position_ecef_m is not None
        assert progress.position_ecef_m[0] == pytest.approx(other.meanX * 1e-2 + other.meanXHP * 1e-4, abs=1e-6)
    last = progress_of(said[-1])
    assert last is not None
    duration_s, accuracy_m, place = SURVEYS[name]
    assert (last.valid, last.duration_s, last.accuracy_m) == (True, duration_s, pytest.approx(accuracy_m))
    assert last.position_ecef_m == pytest.approx(place, abs=1e-4)
    sent = {frame.data for frame in frames if frame.kind == "1005"}
    assert len(sent) == 1
    station = StationDecoder().decode(sent.pop()[3:-3], 1005)
    assert isinstance(station, ReferenceStation)
    assert station.position_ecef_m == pytest.approx(place, abs=1.1e-4)


@pytest.mark.data
def test_two_real_surveys_of_a_day_differ_by_metres_and_are_no_move(data: Path, tmp_path: Path):
    """6.1 m apart; the receiver said 1.3 m and 1.7 m. The third one is five kilometres away: that is a move."""
    places: list[tuple[str, str]] = []
    bus = MemoryBus("base", MemoryNetwork())
    context = Context(id="base", role=Role.INGEST, deployment=Deployment(), bus=bus)
    table = BaseStationTable(mode="survey-in", receiver="ublox-legacy", preset="galway")
    for name in SURVEYS:
        station = BaseStation(context, table, lambda _: True, lambda *_: None, PresetStore(tmp_path))
        station.connected(0.0)
        [file] = data.rglob(f"{name}.ubx.gz")
        for second, frame in enumerate(frame for frame in frames_of(file) if frame.kind == "01-3b"):
            station.tick(float(second))
            station.hear(frame, float(second))
        places.append((station.state, "moved" if station.watch.moved else ""))
    assert places == [("surveyed", ""), ("surveyed", ""), ("surveyed", "moved")]
    codes = [decode(Event, sample.payload).code for level in ("info", "error") for sample in bus.sent(EVENT, level=level)]
    assert codes == ["survey_done", "base_saved", "survey_done", "base_consistent", "survey_done", "base_moved"]
    saved = PresetStore(tmp_path).get("galway")
    assert saved is not None
    assert saved.position_ecef_m == pytest.approx(SURVEYS["base-20181004-1236"][2], abs=1e-4)
