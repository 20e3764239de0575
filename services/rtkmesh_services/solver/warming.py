"""Compiling, or loading from the cache, of the engine's kernels: by solving a few simulated epochs."""

from dataclasses import replace
from functools import cache
from itertools import islice

import numpy as np

from rtkmesh.codecs.messages import Message
from rtkmesh.codecs.stream import StreamDecoder, StreamOptions
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.signals import GPS, SATELLITES_PER_SYSTEM
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.options import Mode, RtkOptions
from rtkmesh.rtk.session import EndOfStream, Session, SessionOptions, Source, pairing_for
from rtkmesh.rtk.standing import Standing
from rtkmesh.simulation.scenario import open_stream
from rtkmesh.simulation.sky import KLOBUCHAR
from rtkmesh_services.mapping.solution import model_zenith_m

EPOCHS = 4
START = GpsTime(2400, 3600.0)


@cache
def warm_engine() -> None:
    """Solve a few simulated epochs in the modes that use different kernels; the second time nothing is left to do."""
    rover, heading, base = (simulated_messages(antenna) for antenna in ("rover", "heading", "base"))
    solve(Mode.KINEMATIC, with_coefficients(rover), base)
    solve(Mode.KINEMATIC, rover, in_parts(base))
    solve(Mode.MOVING_BASE, heading, rover)
    model_zenith_m(np.array((6.4e6, 0.0, 0.0)))
    Standing().place(START, np.array((6.4e6, 0.0, 0.0)), np.zeros(3), np.eye(3))


def simulated_messages(antenna: str) -> list[Message]:
    """Return what the demo's antenna sends in its first epochs, decoded."""
    decoder = StreamDecoder(StreamOptions(approximate_time=START))
    stream = open_stream("demo", antenna, seed=1, rate_hz=5.0, start=START)
    decoded = [part for epoch in islice(stream.epochs(), EPOCHS) for part in decoder.feed(epoch.data)]
    return [message for _, messages in decoded for message in messages] + decoder.flush()


def with_coefficients(messages: list[Message]) -> list[Message]:
    """Return the messages with coefficients of the ionosphere before the last epoch: a receiver sends them when a filter is running."""
    last = [k for k, message in enumerate(messages) if isinstance(message, Epoch)][-1]
    return [*messages[:last], KLOBUCHAR, *messages[last:]]


def in_parts(messages: list[Message]) -> list[Message]:
    """Return the messages of a base whose epochs are not whole: GPS in one, all other systems in the next."""
    epochs = [message for message in messages if isinstance(message, Epoch)]
    gps = [epoch.satellite // SATELLITES_PER_SYSTEM == GPS for epoch in epochs]
    parts = iter([epoch.take(own if k % 2 == 0 else ~own) for k, (epoch, own) in enumerate(zip(epochs, gps, strict=True))])
    return [next(parts) if isinstance(message, Epoch) else message for message in messages]


def slowed(messages: list[Message]) -> list[Message]:
    """Return the messages of a base that is interpolated: of its epochs the first and the last alone."""
    times = [message.time for message in messages if isinstance(message, Epoch)]
    return [message for message in messages if not isinstance(message, Epoch) or message.time in (times[0], times[-1])]


def solve(mode: Mode, rover: list[Message], base: list[Message]) -> int:
    """Run the streams through a session, a slow base interpolated; return the number of solutions."""
    options = RtkOptions(mode=mode)
    session = Session(SessionOptions(options, pairing_for(options, replay=True, interpolate=True)))
    for source, messages in ((Source.BASE, base), (Source.ROVER, rover)):
        for message in messages:
            session.feed(source, message)
        session.feed(source, EndOfStream())
    solutions = list(session.solutions())
    session.engine.candidates()
    if mode is Mode.KINEMATIC and solutions:  # what an operator may do: the rover stands where it is told
        x, y, z = solutions[-1].position_ecef_m.tolist()
        session.engine.go_on(replace(options, mode=Mode.FIXED, fixed_position_ecef_m=(x, y, z)))
    return len(solutions)
