"""RTCM 3 station messages: merging, lengths from the wire, positions of nonsense."""

import pytest

from rtkmesh.codecs.rtcm3_station import StationDecoder, bias_payload, descriptor_payload, position_payload
from rtkmesh.gnss.ephemeris import GlonassBias, ReferenceStation

STATION = ReferenceStation(
    5, (-4467102.3061, 2683039.5304, -3666949.9820), 0.004, "ASH701945C_M    NONE", "CR620023911", "SEPT POLARX5 5.1.0", "rtcm3"
)


def test_what_is_said_of_a_station_is_merged_and_told_when_it_changes():
    """1006, then 1008, then 1033 give three states; repeats give none; another station is another one."""
    decoder = StationDecoder()
    states = [
        decoder.decode(payload, number)
        for payload, number in (
            (position_payload(STATION, with_height=True), 1006),
            (position_payload(STATION, with_height=True), 1006),
            (descriptor_payload(STATION, 1008), 1008),
            (descriptor_payload(STATION, 1033), 1033),
            (descriptor_payload(STATION, 1007), 1007),
            (position_payload(STATION, with_height=False), 1005),
        )
    ]
    assert [state is not None for state in states] == [True, False, True, True, False, False]
    assert states[3] == STATION


def test_a_repeated_message_is_told_again_after_another_one_has_changed_what_it_says():
    """Two antennas that take turns: each change is told, though the bytes are those of before."""
    decoder = StationDecoder()
    other = ReferenceStation(5, STATION.position_ecef_m, antenna="LEIAR25.R3      NONE")
    told = [
        decoder.decode(descriptor_payload(station, 1007), 1007) for station in (STATION, STATION, other, other, STATION, STATION, other)
    ]
    assert [state.antenna if isinstance(state, ReferenceStation) else state for state in told] == [
        STATION.antenna, None, other.antenna, None, STATION.antenna, None, other.antenna
    ]  # fmt: skip


def test_a_moved_base_is_told_at_once():
    """The decoder does not judge a move: it reports the new position (the solver decides)."""
    decoder = StationDecoder()
    decoder.decode(position_payload(STATION, with_height=False), 1005)
    moved = ReferenceStation(5, (-4467112.3061, 2683039.5304, -3666949.9820))
    state = decoder.decode(position_payload(moved, with_height=False), 1005)
    assert isinstance(state, ReferenceStation)
    assert state.position_ecef_m == pytest.approx(moved.position_ecef_m)


@pytest.mark.parametrize("position", [(0.0, 0.0, 0.0), (1.3e7, 1.3e7, 0.0), (6.0e6, 0.0, 0.0)])
def test_a_position_that_is_not_on_earth_is_rejected(position: tuple[float, float, float]):
    decoder = StationDecoder()
    assert decoder.decode(position_payload(ReferenceStation(1, position), with_height=True), 1006) == "not on earth"


@pytest.mark.parametrize("number", [1005, 1006, 1007, 1008, 1033, 1230])
def test_every_cut_is_rejected_without_reading_over_the_end(number: int):
    """A payload cut anywhere before its last field ends is too short: lengths from the wire are checked against what is there."""
    if number == 1230:
        payload = bias_payload(GlonassBias(5, True, (1.0, 2.0, 3.0, 4.0)))
    else:
        payload = position_payload(STATION, with_height=number == 1006) if number < 1007 else descriptor_payload(STATION, number)
    needed = len(payload) - (1 if number == 1007 else 0)  # the setup id behind the antenna is not used
    for length in range(2, needed):
        assert StationDecoder().decode(payload[:length], number) == "too short"
    assert not isinstance(StationDecoder().decode(payload, number), str)


def test_announced_lengths_beyond_the_payload_are_rejected():
    """1033 with a text of 255 characters in a message of 20 bytes (a known overflow of other decoders)."""
    payload = (1033 << 12 | 5).to_bytes(3, "big") + b"\xff" + bytes(16)
    assert StationDecoder().decode(payload, 1033) == "too short"


def test_texts_are_printable():
    """Control characters, markup bytes beyond ASCII and padding do not come through."""
    text = b"\x00<b>\x1b[31m\xffTRM\n  "
    payload = (1007 << 12 | 5).to_bytes(3, "big") + bytes((len(text),)) + text + b"\x00"
    state = StationDecoder().decode(payload, 1007)
    assert isinstance(state, ReferenceStation)
    assert state.antenna == "<b>[31mTRM"


def test_memory_is_bounded_over_many_station_ids():
    """After thousands of ids the first one is told again, as if it were new."""
    decoder = StationDecoder()
    for station_id in (*range(4000), 0):
        assert decoder.decode(position_payload(ReferenceStation(station_id, STATION.position_ecef_m), with_height=True), 1006) is not None


def test_an_unset_bias_is_nan_and_a_repeat_is_silent():
    decoder, bias = StationDecoder(), GlonassBias(5, False, (float("nan"), 1.0, 2.0, float("nan")))
    assert isinstance(decoder.decode(bias_payload(bias), 1230), GlonassBias)
    assert decoder.decode(bias_payload(bias), 1230) is None


def test_a_station_without_position_has_no_position_message():
    with pytest.raises(ValueError, match="no position"):
        position_payload(ReferenceStation(1), with_height=True)
