"""Looking ahead: what a recording tells in its first minutes is known from the start, once, and nothing else moves."""

import numpy as np

from rtkmesh.gnss.ephemeris import KlobucharParameters, ReferenceStation
from rtkmesh.gnss.epoch import Epoch, make_epoch
from rtkmesh.gnss.signals import satellite_number
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.session import EndOfStream, Source
from rtkmesh.simulation.sky import broadcast
from rtkmesh_services.cli.lookahead import AHEAD_S, Item, looking_ahead

START = GpsTime(2445, 100000.0)
G05, R07 = (broadcast(satellite_number(name), START) for name in ("G05", "R07"))
G05_LATER = broadcast(satellite_number("G05"), START + 7200.0)
STATION = ReferenceStation(1, (4e6, 6e5, 4.9e6))
NAMELESS = ReferenceStation(1, None, receiver="SEPT POLARX5")
IONOSPHERE = KlobucharParameters("G", (1e-8, 0.0, 0.0, 0.0), (1e5, 0.0, 0.0, 0.0))


def epoch(seconds: float) -> Epoch:
    return make_epoch(START + seconds, satellite=[5], signal=[1], pseudorange_m=[2.2e7])


def test_the_first_of_everything_that_lasts_comes_first() -> None:
    """Ephemerides per satellite, ionosphere, base position; a station without a position, later issues and epochs stay where they are."""
    rover: list[Item] = [(Source.ROVER, m) for m in (epoch(0.0), G05, epoch(1.0), R07, G05_LATER, IONOSPHERE, epoch(2.0))]
    base: list[Item] = [(Source.BASE, m) for m in (NAMELESS, epoch(0.0), STATION)]
    items: list[Item] = [*rover, *base, (Source.ROVER, EndOfStream())]
    found = list(looking_ahead(items))
    expected = [(Source.ROVER, G05), (Source.ROVER, R07), (Source.ROVER, IONOSPHERE), (Source.BASE, STATION)]
    assert found[: len(expected)] == expected
    assert [id(m) for _, m in found[len(expected) :]] == [id(m) for _, m in items]


def test_it_looks_no_further_than_two_minutes() -> None:
    """What comes later is known when it comes, and a recording is not read to its end before its first epoch is solved."""
    read: list[float] = []

    def items():
        for k in range(1000):
            read.append(float(k))
            yield Source.ROVER, epoch(float(k))
            if k == int(AHEAD_S) + 5:
                yield Source.ROVER, G05

    source, message = next(looking_ahead(items()))
    assert (source, message.time) == (Source.ROVER, START)
    assert np.isclose(read[-1], AHEAD_S + 1.0)


def test_nothing_of_nothing() -> None:
    """No recording, and one without epochs, are given back as they are."""
    assert list(looking_ahead([])) == []
    assert list(looking_ahead([(Source.NAVIGATION, R07)])) == [(Source.NAVIGATION, R07), (Source.NAVIGATION, R07)]
