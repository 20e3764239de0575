"""The session: navigation data count only for what follows them; options change without losing them; memory is bounded."""

from itertools import islice

import pytest

from rtkmesh.codecs.messages import Message
from rtkmesh.codecs.stream import StreamDecoder, StreamOptions
from rtkmesh.gnss.ephemeris import GlonassEphemeris, KeplerEphemeris, KlobucharParameters
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.options import Mode, RtkOptions
from rtkmesh.rtk.session import EndOfStream, Session, SessionOptions, Source, pairing_for
from rtkmesh.rtk.solution import Solution, Status
from rtkmesh.simulation.scenario import open_stream

START = GpsTime(2400, 3600.0)
EPHEMERIS = KeplerEphemeris | GlonassEphemeris


def messages(antenna: str, epochs: int = 15) -> list[Message]:
    decoder = StreamDecoder(StreamOptions(approximate_time=START))
    stream = open_stream("demo", antenna, seed=2, rate_hz=5.0, start=START).epochs()
    return [m for epoch in islice(stream, epochs) for _, found in decoder.feed(epoch.data) for m in found]


def session(mode: Mode, *, replay: bool = True, navigation_streams: int = 0) -> Session:
    options = RtkOptions(mode=mode)
    return Session(SessionOptions(options, pairing_for(options, replay=replay), navigation_streams=navigation_streams))


def run(order: str, mode: Mode = Mode.KINEMATIC) -> list[Solution]:
    """Feed the demo's rover and base with their messages interleaved in one of three ways."""
    streams = {Source.ROVER: messages("rover"), Source.BASE: messages("base")}
    fed = session(mode)
    if order == "alternating":
        pairs = zip(streams[Source.ROVER], streams[Source.BASE], strict=False)
        shared = min(len(one) for one in streams.values())
        sequence = [(source, m) for pair in pairs for source, m in zip(streams, pair, strict=True)]
        sequence += [(source, m) for source, rest in streams.items() for m in rest[shared:]]
    else:
        first, second = (Source.ROVER, Source.BASE) if order == "rover first" else (Source.BASE, Source.ROVER)
        sequence = [(source, m) for source in (first, second) for m in streams[source]]
    solutions: list[Solution] = []
    for source, message in sequence:
        fed.feed(source, message)
        solutions += fed.solutions()
    for source in streams:
        fed.feed(source, EndOfStream())
    return solutions + list(fed.solutions())


@pytest.mark.parametrize("order", ["rover first", "alternating"])
def test_solutions_do_not_depend_on_how_the_streams_were_interleaved(order: str) -> None:
    """Bit for bit, though ephemerides come in both streams between the epochs."""
    expected, got = run("base first"), run(order)
    assert len(expected) == len(got) == 15
    for one, other in zip(expected, got, strict=True):
        assert one.time == other.time
        assert one.status is other.status
        assert one.position_ecef_m.tobytes() == other.position_ecef_m.tobytes()
        assert one.position_cov_ecef_m2.tobytes() == other.position_cov_ecef_m2.tobytes()
    assert expected[-1].status is Status.FIX


def test_an_ephemeris_counts_only_for_epochs_that_follow_it_in_its_stream() -> None:
    everything = messages("rover")
    epochs = [m for m in everything if isinstance(m, Epoch)]
    navigation = [m for m in everything if isinstance(m, EPHEMERIS | KlobucharParameters)]
    fed = session(Mode.SINGLE)
    for message in (*epochs[:5], *navigation, *epochs[5:]):
        fed.feed(Source.ROVER, message)
    statuses = [solution.status for solution in fed.solutions()]
    assert statuses == [Status.NONE] * 5 + [Status.SINGLE] * 10


def test_navigation_files_are_waited_for_in_a_replay() -> None:
    everything = messages("rover")
    fed = session(Mode.SINGLE, navigation_streams=1)
    for message in everything:
        fed.feed(Source.ROVER, message)
    assert list(fed.solutions()) == []
    fed.feed(Source.NAVIGATION, EndOfStream())
    assert len(list(fed.solutions())) == 15


def test_a_restart_keeps_navigation_data_and_takes_new_options() -> None:
    everything = messages("rover")
    fed = session(Mode.SINGLE)
    for message in everything[: len(everything) // 2]:
        fed.feed(Source.ROVER, message)
    before = len(list(fed.solutions()))
    options = RtkOptions(mode=Mode.SINGLE, systems="G")
    fed.restart(SessionOptions(options, pairing_for(options, replay=True)))
    for message in everything[len(everything) // 2 :]:
        fed.feed(Source.ROVER, message)
    after = list(fed.solutions())
    assert before + len(after) == 15
    assert all(solution.status is Status.SINGLE for solution in after[1:])
    assert max(solution.satellites_used for solution in after) <= 14


def test_navigation_data_of_a_base_without_rover_do_not_pile_up() -> None:
    fed = session(Mode.KINEMATIC, replay=False)
    ephemerides = [m for m in messages("base") if isinstance(m, EPHEMERIS)]
    for k in range(6000):
        fed.feed(Source.BASE, ephemerides[k % len(ephemerides)], float(k))
    assert len(fed._other_pending) <= 4096
