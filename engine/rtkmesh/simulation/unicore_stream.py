"""What a Unicore receiver with two antennas sends: OBSVM, OBSVH, BESTNAV and UNIHEADING at every epoch, ephemerides as it hears them."""

from rtkmesh.codecs.unicore_encode import encode_ephemeris, encode_heading, encode_observations, encode_position
from rtkmesh.simulation.own_fix import OwnFix
from rtkmesh.simulation.own_heading import OwnHeading
from rtkmesh.simulation.receiver import Observed
from rtkmesh.simulation.schedule import EphemerisSchedule
from rtkmesh.simulation.sky import broadcast


class UnicoreStream:
    """Turns observed epochs of a main and a second antenna into the bytes of one receiver."""

    def __init__(self, seed: int, *, warm: bool) -> None:
        self._schedule = EphemerisSchedule(warm=warm)
        self._fix, self._heading = OwnFix(seed), OwnHeading(seed)

    def encode(self, main: Observed, second: Observed) -> bytes:
        """Return all bytes of an epoch."""
        now = main.epoch.time
        parts = [encode_observations(main.epoch, "OBSVM"), encode_observations(second.epoch, "OBSVH"), encode_position(self._fix(main))]
        parts.append(encode_heading(self._heading(main, second)))
        due = self._schedule.due(main.epoch.satellite, main.true_time)
        parts += [encode_ephemeris(broadcast(satellite, main.true_time), now) for satellite in due]
        return b"".join(parts)
