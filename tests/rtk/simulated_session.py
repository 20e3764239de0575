"""Live sessions of two simulated receivers, without bytes in between."""

from collections.abc import Iterator

from rtkmesh.gnss.ephemeris import ReferenceStation
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.options import RtkOptions
from rtkmesh.rtk.session import Session, SessionOptions, Source, pairing_for
from rtkmesh.rtk.solution import Solution
from rtkmesh.simulation.receiver import Receiver
from rtkmesh.simulation.scenario import SimulatedStream, truth
from rtkmesh.simulation.sky import SATELLITES, broadcast


def solutions(options: RtkOptions, seed: int, start: GpsTime, rate_hz: float, epochs: int) -> Iterator[Solution]:
    """Yield what a live session that knows ephemerides and the base's position makes of so many epochs of the scenario ``demo``."""
    ends: dict[Source, Receiver] = {
        source: SimulatedStream("demo", name, seed=seed, rate_hz=rate_hz, start=start).receiver()
        for source, name in ((Source.ROVER, "rover"), (Source.BASE, "base"))
    }
    session = Session(SessionOptions(options, pairing_for(options, replay=False)))
    for satellite in SATELLITES.tolist():
        session.feed(Source.NAVIGATION, broadcast(satellite, start))
    x, y, z = truth("demo", seed=seed)(start).antennas_ecef_m["base"].tolist()
    session.feed(Source.BASE, ReferenceStation(1, (x, y, z)), 0.0)
    for k in range(epochs):
        for source, receiver in ends.items():
            session.feed(source, receiver.observe(start + k / rate_hz).epoch, k / rate_hz)
        yield from session.solutions(k / rate_hz + 0.01)
