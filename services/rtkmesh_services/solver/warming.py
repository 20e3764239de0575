"""Compiling, or loading from the cache, of the engine's kernels: by solving a few simulated epochs."""

from rtkmesh.simulation.scenario import warm_up_messages

from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.options import Mode, RtkOptions
from rtkmesh.rtk.session import Session, SessionOptions, Source, pairing_for

EPOCHS = 3


def warm_engine() -> None:
    """Solve a few simulated epochs in the modes that use different kernels."""
    rover, base = warm_up_messages(GpsTime(2400, 0.0), EPOCHS)
    for mode in (Mode.KINEMATIC, Mode.MOVING_BASE):
        options = RtkOptions(mode=mode)
        session = Session(SessionOptions(options, pairing_for(options, replay=False)))
        for message in base:
            session.feed(Source.BASE, message)
        for message in rover:
            session.feed(Source.ROVER, message)
        list(session.solutions(1e9))
