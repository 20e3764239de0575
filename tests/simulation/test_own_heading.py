"""The heading that a simulated receiver with two antennas sends of itself, as the bytes of UNIHEADING say it."""

from itertools import islice
from math import degrees, pi

import numpy as np

from rtkmesh.attitude.rotation import wrapped
from rtkmesh.codecs.stream import StreamDecoder
from rtkmesh.gnss.receiver import CarrierSolution, ReceiverHeading
from rtkmesh.gnss.time import GpsTime
from rtkmesh.simulation.scenario import open_stream, truth

START = GpsTime(2445, 345_600.0)


def headings(scenario: str, epochs: int, rate_hz: float = 1.0) -> list[ReceiverHeading]:
    stream, decoder = open_stream(scenario, "rover+heading", seed=3, rate_hz=rate_hz, start=START), StreamDecoder()
    decoded = [message for epoch in islice(stream.epochs(), epochs) for _, found in decoder.feed(epoch.data) for message in found]
    return [message for message in decoded if isinstance(message, ReceiverHeading)]


def test_headings_are_the_truth_within_their_sigmas() -> None:
    """From antenna 1 to antenna 2, which is ahead of it: the vehicle's own heading and pitch."""
    found, at = headings("demo", 60), truth("demo", seed=3)
    assert len(found) == 60
    assert {heading.solution for heading in found} == {CarrierSolution.FIXED}
    assert all(heading.of_baseline and heading.time is not None for heading in found)
    off = []
    for heading in found:
        assert heading.time is not None
        true = at(heading.time)
        turned = wrapped(heading.heading_rad - true.heading_rad) / heading.heading_sigma_rad
        off.append([turned, (heading.pitch_rad - true.pitch_rad) / heading.pitch_sigma_rad])
        assert degrees(heading.heading_sigma_rad) < 0.3
        assert 0.9 < heading.length_m < 1.1
    assert 0.6 < np.square(off).mean() < 1.5


def test_under_water_it_has_none() -> None:
    """Never north: what is not known is not valid."""
    found = headings("auv", 35)
    none = [heading for heading in found if not heading.valid]
    assert 3 <= len(none) <= 12
    assert all(np.isnan(heading.heading_rad) and heading.solution is CarrierSolution.NONE for heading in none)
    assert all(0.0 <= heading.heading_rad < 2.0 * pi for heading in found if heading.valid)
