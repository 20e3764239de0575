"""Corrections to a receiver: which messages, which epochs on a slow link, what the receiver says of them."""

from collections.abc import Iterator

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyrtcm import RTCMReader
from pyubx2 import GET, UBXMessage

from rtkmesh.codecs.messages import Frame, Protocol
from rtkmesh.codecs.rtcm3_encode import encode_epoch, encode_glonass_bias, encode_station, frame
from rtkmesh.gnss.ephemeris import GlonassBias, ReferenceStation
from rtkmesh.gnss.epoch import make_epoch
from rtkmesh.gnss.signals import NO_CHANNEL, satellite_number, signal_number
from rtkmesh.gnss.time import GpsTime
from rtkmesh_schemas.config import CorrectionsTable
from rtkmesh_services.ingest.correction_feed import BaseChoice
from rtkmesh_services.ingest.correction_gate import Correction, CorrectionGate, is_observation
from rtkmesh_services.ingest.corrections import CorrectionQueue
from rtkmesh_services.ingest.feedback import Feedback, Verdict, verdict_of_frame, verdict_of_line
from rtkmesh_services.ntrip.frames import message_number

STATION = ReferenceStation(7, (4027893.75, 307045.6, 4919474.9), antenna="LEIAR25.R3 LEIT")


def table(**values: object) -> CorrectionsTable:
    return msgspec.convert({"from": ["base"], **values}, CorrectionsTable)


def epoch(second: int) -> list[bytes]:
    """Return the MSM7 frames of an epoch of three systems: 1077, 1087, 1097, 1127."""
    satellites = ["G05", "G07", "G08", "R07", "R08", "E11", "E12", "C23", "C24"]
    signals = {"G": "1C", "R": "1C", "E": "1C", "C": "2I"}
    count = len(satellites)
    made = make_epoch(
        GpsTime(2400, 100.0 + second),
        satellite=[satellite_number(name) for name in satellites],
        signal=[signal_number(signals[name[0]]) for name in satellites],
        channel=[1 if name[0] == "R" else NO_CHANNEL for name in satellites],
        pseudorange_m=[2.2e7 + 1e4 * index for index in range(count)],
        phase_cyc=[1.1e8] * count,
        doppler_hz=[10.0] * count,
        cn0_dbhz=[45.0] * count,
        lock_s=[9.0] * count,
    )
    return encode_epoch(made, 7)


EPOCHS = [epoch(second) for second in range(8)]
STATION_FRAMES = [*encode_station(STATION), encode_glonass_bias(GlonassBias(7, True, (0.0, 0.0, 0.0, 0.0)))]


def numbers(frames: list[bytes]) -> list[int]:
    return [message_number(data) for data in frames]


def more_bits(frames: list[bytes]) -> list[int]:
    """Return the multiple-message bits as pyrtcm reads them."""
    return [RTCMReader.parse(data).DF393 for data in frames]


def through(gate: CorrectionGate, frames: list[bytes], now_s: float = 0.0) -> list[Correction]:
    return [correction for data in frames for correction in gate.take(data, now_s)]


def test_basic_is_observations_and_places_and_full_is_all():
    stream = [*STATION_FRAMES, *EPOCHS[0], frame(bytes([0x3F, 0xB0, *range(60)]))]
    basic = [correction.number for correction in through(CorrectionGate(table()), stream)]
    full = [correction.number for correction in through(CorrectionGate(table(set="full")), stream)]
    assert full == numbers(stream)
    assert basic == [number for number in full if number not in (1007, 1008, 1033, 1019)]
    assert basic == [1006, 1230, 1077, 1087, 1097, 1127]


def test_accept_names_messages_and_reject_goes_first():
    stream = [*STATION_FRAMES, *EPOCHS[0]]
    gate = CorrectionGate(table(accept=[1033, 1077, 1087], reject=[1087]))
    assert [gate.passes(number) for number in (1033, 1077, 1087, 1097)] == [True, True, False, False]
    assert {correction.number for correction in through(gate, stream)} == {1033, 1077}


def test_epochs_are_counted_by_the_bit_of_their_messages():
    found = through(CorrectionGate(table(set="full")), [*EPOCHS[0], *STATION_FRAMES, *EPOCHS[1], *EPOCHS[2]])
    assert [c.epoch for c in found if is_observation(c.number)] == [1] * 4 + [2] * 4 + [3] * 4
    assert {c.epoch for c in found if not is_observation(c.number)} == {0}


def test_a_lost_last_message_does_not_join_two_epochs():
    found = through(CorrectionGate(table()), [*EPOCHS[0][:-1], *EPOCHS[1]])
    assert [c.epoch for c in found] == [1, 1, 1, 2, 2, 2, 2]


def test_the_bit_is_right_where_the_last_system_is_left_out():
    """The receiver would wait for 1127 until its timeout. pyrtcm reads the bits and checks the CRC."""
    gate = CorrectionGate(table(reject=[1127]))
    through(gate, EPOCHS[0])
    later = [c.frame for c in through(gate, [*EPOCHS[1], *EPOCHS[2]])]
    assert numbers(later) == [1077, 1087, 1097] * 2
    assert more_bits(later) == [1, 1, 0] * 2
    untouched = [data for epoch_frames in EPOCHS[1:3] for data in epoch_frames[:2]]
    assert [data for data in later if message_number(data) != 1097] == untouched


def test_a_message_that_waits_for_its_epoch_does_not_wait_for_ever():
    gate = CorrectionGate(table(reject=[1127]))
    through(gate, EPOCHS[0])
    assert numbers([c.frame for c in through(gate, EPOCHS[1][:1], 5.0)]) == []
    assert gate.flush(5.1) == []
    [late] = gate.flush(5.4)
    assert (late.number, more_bits([late.frame])) == (1077, [0])


def test_legacy_messages_have_their_bits_elsewhere():
    """1004: DF005 at bit 54; 1012: DF035 at bit 51 (pyrtcm reads them)."""
    gps = frame((1004 << 52 | 7 << 40 | 5000 << 10 | 1 << 9).to_bytes(8, "big"))
    glonass = frame((1012 << 52 | 7 << 40 | 777 << 13 | 1 << 12).to_bytes(8, "big"))
    assert RTCMReader.parse(gps).DF005 == 1
    assert RTCMReader.parse(glonass).DF005 == 1
    gate = CorrectionGate(table(reject=[1097]))
    through(gate, [EPOCHS[0][2]])
    assert through(gate, [gps]) == []
    [held] = gate.flush(1.0)
    assert RTCMReader.parse(held.frame).DF005 == 0
    assert RTCMReader.parse(held.frame).DF004 == RTCMReader.parse(gps).DF004
    assert through(gate, [glonass], 2.0) == []
    [held] = gate.flush(3.0)
    assert (RTCMReader.parse(held.frame).DF005, RTCMReader.parse(held.frame).DF034) == (0, 777)


@given(st.lists(st.binary(max_size=40).map(frame), max_size=20))
def test_any_frames_pass_or_are_left_out(frames: list[bytes]):
    gate, queue = CorrectionGate(table(reject=[1127])), CorrectionQueue(100.0)
    for correction in through(gate, frames) + gate.flush(10.0):
        queue.put(correction, 0.0)
    while queue.get(0.0) is not None:
        pass


class Line:
    """A link that carries so many bytes a second, beside a base that sends an epoch a second."""

    def __init__(self, bytes_per_s: float) -> None:
        self.queue, self.gate = CorrectionQueue(bytes_per_s), CorrectionGate(table(set="full"))
        self.queue.opened(0.0, lambda: None)
        self.written: list[Correction] = []
        self._free_s = 0.0

    def run(self, frames: list[bytes], now_s: float, until_s: float) -> None:
        for correction in through(self.gate, frames, now_s):
            self.queue.put(correction, now_s)
        self._free_s = max(self._free_s, now_s)
        while self._free_s < until_s and (found := self.queue.get(self._free_s)) is not None:
            self.queue.written(found, self._free_s)
            self.written.append(found)
            self._free_s += len(found.frame) / self.queue.rate

    def epochs(self) -> dict[int, list[int]]:
        found: dict[int, list[int]] = {}
        for correction in self.written:
            if correction.epoch:
                found.setdefault(correction.epoch, []).append(correction.number)
        return found


def test_a_link_that_carries_everything_drops_nothing():
    line = Line(5.0 * sum(map(len, EPOCHS[0])))
    for second, frames in enumerate(EPOCHS):
        line.run([*STATION_FRAMES, *frames], float(second), second + 1.0)
    assert numbers([c.frame for c in line.written if c.epoch]) == numbers([data for frames in EPOCHS for data in frames])
    assert line.queue.counts.dropped.total() == 0


@pytest.mark.parametrize("share", [0.7, 0.45, 0.2])
def test_a_slow_link_gets_whole_epochs_the_newest_ones_and_every_place(share: float):
    size = sum(map(len, EPOCHS[0]))
    line = Line(share * size)
    seconds = 60
    for second in range(seconds):
        line.run([*(STATION_FRAMES if second % 10 == 0 else []), *epoch(second)], float(second), second + 1.0)
    line.run([], float(seconds), seconds + 20.0)
    epochs = line.epochs()
    assert all(found == [1077, 1087, 1097, 1127] for found in epochs.values()), "no epoch is cut"
    assert list(epochs) == sorted(epochs)
    assert 0.7 * share * seconds < len(epochs) < seconds
    counts = line.queue.told()
    for number in numbers(STATION_FRAMES):
        assert counts.written[number] + counts.replaced[number] == counts.queued[number] == 6
        assert counts.dropped[number] == 0
    assert counts.dropped_epochs == seconds - len(epochs)
    assert all(counts.queued[n] == counts.written[n] + counts.dropped[n] for n in (1077, 1087, 1097, 1127))


def test_a_place_waits_for_no_epoch_and_the_newest_one_counts():
    queue, gate = CorrectionQueue(100.0), CorrectionGate(table(set="full"))
    old, new = (encode_station(ReferenceStation(7, (4027893.0 + metre, 307045.6, 4919474.9)))[0] for metre in (0, 1))
    for data in (*EPOCHS[0], old, *EPOCHS[1], new):
        for correction in gate.take(data, 0.0):
            queue.put(correction, 0.0)
    first = queue.get(0.0)
    assert first is not None
    assert first.frame == new
    assert queue.counts.replaced.total() == 1


def test_what_waited_while_nothing_was_connected_is_not_sent():
    queue = CorrectionQueue(None)
    for correction in through(CorrectionGate(table(set="full")), [*STATION_FRAMES, *EPOCHS[0][:2]]):
        queue.put(correction, 0.0)
    queue.opened(960.0, lambda: None)
    assert queue.rate == 960.0
    for correction in [Correction(data, message_number(data), 1, 0.0) for data in EPOCHS[0][2:]]:
        queue.put(correction, 0.0)
    found = [correction.number for correction in iter(lambda: queue.get(0.0), None)]
    assert found == numbers(STATION_FRAMES), "the rest of an epoch whose beginning was dropped goes as well"


def test_what_is_old_goes():
    queue = CorrectionQueue(0.0)
    for correction in through(CorrectionGate(table()), EPOCHS[0]):
        queue.put(correction, 0.0)
    assert queue.get(16.0) is None
    assert queue.counts.dropped.total() == 4


def test_another_base_begins_anew():
    queue, gate = CorrectionQueue(0.0), CorrectionGate(table(set="full"))
    for correction in through(gate, [*STATION_FRAMES, *EPOCHS[0], *EPOCHS[1]]):
        queue.put(correction, 0.0)
    queue.restart()
    assert not queue.waiting
    for correction in through(CorrectionGate(table()), EPOCHS[2]):
        queue.put(correction, 0.0)
    assert [c.number for c in iter(lambda: queue.get(0.0), None)] == [1077, 1087, 1097, 1127]


def speak(choice: BaseChoice, *heard: tuple[float, int]) -> list[int | None]:
    found: list[int | None] = []
    for now_s, base in heard:
        choice.heard(base, now_s)
        found.append(choice.active)
    return found


def seconds(first: int, last: int, base: int) -> Iterator[tuple[float, int]]:
    yield from ((float(second), base) for second in range(first, last))


def test_the_first_base_that_speaks_is_used():
    assert speak(BaseChoice(2, 10.0), (0.0, 1), (1.0, 0), (2.0, 1)) == [None, 0, 0]


def test_the_next_base_is_used_while_the_first_is_silent_and_left_when_it_is_back():
    choice = BaseChoice(2, 10.0)
    assert set(speak(choice, *seconds(0, 11, 1))) == {None, 1}
    both = sorted([*seconds(11, 20, 0), *seconds(11, 20, 1)])
    found = speak(choice, *both)
    assert (found[0], found[-1]) == (1, 0)
    assert found.count(1) == 10, "it must speak for five seconds"
    assert set(speak(choice, *seconds(20, 29, 1))) == {0}
    assert speak(choice, (29.5, 1))[-1] == 1


def rxm_rtcm(number: int, flags: int, station: int = 7) -> Frame:
    message = UBXMessage(0x02, 0x32, GET, version=2, crcFailed=flags & 1, msgUsed=flags >> 1, refStation=station, msgType=number)
    return Frame(Protocol.UBX, "02-32", message.serialize())


def test_the_receivers_word_is_read_as_pyubx2_writes_it():
    words = [verdict_of_frame(rxm_rtcm(1077, flags)) for flags in (0, 1, 2, 4)]
    assert words == [Verdict(1077, word, 7) for word in ("unknown", "crc_failed", "not_used", "used")]
    assert verdict_of_frame(Frame(Protocol.UBX, "02-32", bytes(12))) is None
    assert verdict_of_frame(Frame(Protocol.UBX, "01-07", bytes(100))) is None


def test_a_unicore_receiver_names_what_it_decoded():
    line = "#RTCMSTATUSA,76,GPS,FINE,2219,392572000,0,0,18,187;1124,21186,42,21,0,6,11,0,0,21*c1b2aff3"
    assert verdict_of_line(line) == Verdict(1124, "unknown", 42)
    assert verdict_of_line("#RTCMSTATUSA,76;1124,x,1,2*00") is None
    assert verdict_of_line("#BESTNAVA,76;1124,1,1,2*00") is None


def test_corrections_that_are_not_used_for_long_are_a_complaint():
    feedback = Feedback()
    for second in range(20):
        feedback.hear(Verdict(1077, "not_used", 7), float(second))
    assert "uses none of them" in feedback.complaint(19.0)
    assert feedback.complaint(60.0) == "", "what was said long ago says nothing"
    feedback.hear(Verdict(1077, "used", 7), 20.0)
    assert feedback.complaint(20.0) == ""
    assert feedback.data(21.0) == {"messages": {"1077": {"not_used": 20, "used": 1}}, "crc_failed": 0, "station_id": 7, "age_s": 1.0}
