"""Navigation blocks, as they arrive, to ephemerides: gathers sets, waits for a time, publishes each new set once.

The 10-bit week of LNAV and the day of GLONASS need a time near the transmission. It comes from the caller (``set_time``: the
receiver's own epochs) or, until then, from messages that carry a full date (Galileo, BeiDou, GLONASS with string 5). Complete
sets wait for it. When the caller's time is first known or jumps by more than an hour, all complete sets are dated anew.
"""

from dataclasses import fields
from operator import attrgetter
from typing import Final

from rtkmesh.codecs.ephemerides import (
    beidou_time,
    d1_ephemeris,
    d2_ephemeris,
    glonass_ephemeris,
    glonass_time,
    inav_ephemeris,
    inav_time,
    klobuchar,
    lnav_ephemeris,
    moscow_time,
)  # fmt: skip
from rtkmesh.codecs.navigation_words import (
    D1_MESSAGE,
    D2_MESSAGE,
    GIVEN_CLOCK,
    GLONASS_MESSAGE,
    INAV_MESSAGE,
    IONOSPHERE_SUBFRAME,
    LNAV_MESSAGE,
    NO_CLOCK,
    OWN_CLOCK,
    QUIET,
    REFUSALS,
    Refusal,
    Words,
    block_of,
    new_satellites,
    set_is_whole,
    take_block,
)  # fmt: skip
from rtkmesh.codecs.subframes import D1, D2_EPHEMERIS, D2_PAGE_BITS, GLONASS_STRING, GLONASS_TB_UNIT_S, INAV, LNAV
from rtkmesh.gnss.constants import SECONDS_PER_WEEK
from rtkmesh.gnss.ephemeris import Ephemeris, GlonassEphemeris, KeplerEphemeris, KlobucharParameters
from rtkmesh.gnss.signals import MAX_SATELLITE, SATELLITES_PER_SYSTEM
from rtkmesh.gnss.time import GpsTime

NavigationData = Ephemeris | KlobucharParameters

_TIME_JUMP_S: Final = 3600.0
_GLONASS_INTERVAL_S: Final = 900.0 - 60.0  # the time of reception is known to some seconds
_GLONASS_FRAME_S: Final = 30.0

# Of a message: the blocks of an ephemeris, the bits of a block, and of a word of it.
_BLOCKS: Final = {
    LNAV_MESSAGE: (3, 300, 30),
    INAV_MESSAGE: (5, 128, 32),
    D1_MESSAGE: (3, 300, 30),
    D2_MESSAGE: (10, D2_PAGE_BITS, 30),
    GLONASS_MESSAGE: (4, 85, 32),
}


class NavigationDecoder:
    """Turns the navigation blocks of one stream into ephemerides and ionosphere parameters.

    The kernels of ``navigation_words`` take a block into ``satellites``, with the time that ``now`` says (what is known of it, week, time
    of week in s); ``look`` makes of it what can be made. With ``repeats`` a set that says nothing new is published as well.
    """

    def __init__(self, approximate_time: GpsTime | None = None, *, repeats: bool = False) -> None:
        self._repeats = repeats
        self.satellites = new_satellites(MAX_SATELLITE)
        self.now = (NO_CLOCK, 0, 0.0)
        self._time: GpsTime | None = None
        self._messages: dict[int, int] = {}  # by satellite, in the order of their first blocks
        self._published: dict[int, Ephemeris] = {}  # by satellite
        self._ionosphere: dict[int, KlobucharParameters] = {}  # by system: published last
        self._ionosphere_of: dict[int, KlobucharParameters] = {}  # by satellite: said last
        if approximate_time is not None:
            self._set(approximate_time, GIVEN_CLOCK)

    @property
    def time(self) -> GpsTime | None:
        """The newest time that the weeks are resolved by."""
        return self._time

    def set_time(self, time: GpsTime) -> list[NavigationData]:
        """Take a time of the receiver; return what had waited for it."""
        known = self._time if self.now[0] == GIVEN_CLOCK else None
        self._set(time, GIVEN_CLOCK)
        if known is not None and abs(time - known) < _TIME_JUMP_S:
            return []
        found: list[NavigationData] = []
        for satellite, message in self._messages.items():
            self.satellites[satellite]["settled"] = 0
            found += self._publish(satellite, message)
        return found

    def take(self, satellite: int, message: int, words: Words, channel: int = 0, frame: int = 0) -> list[NavigationData] | Refusal:
        """Take one block (see ``navigation_words``); return what comes of it, or why it is refused."""
        result = take_block(self.satellites, satellite, message, words, channel, frame, *self.now)
        if result >= 0:
            return self.look(satellite, message, result)
        return [] if result == QUIET else REFUSALS[result]

    def look(self, satellite: int, message: int, index: int) -> list[NavigationData]:
        """Return what comes of the block with this index that a kernel says is to be looked at."""
        if message == LNAV_MESSAGE and index == IONOSPHERE_SUBFRAME:
            return self._publish_ionosphere(satellite, LNAV[4].read(self._blocks(satellite, message, 4)[4]))
        if message == INAV_MESSAGE and index == 0:
            self._suggest(inav_time(INAV[0].read(self._blocks(satellite, message, 0)[0]), self._time))
            return []
        self._messages.setdefault(satellite, message)
        return self._first_values(satellite, message, index) + self._publish(satellite, message)

    def _first_values(self, satellite: int, message: int, index: int) -> list[NavigationData]:
        """Take from a block what need not wait for the others: a time, the ionosphere."""
        if message == INAV_MESSAGE and index == 5:
            self._suggest(inav_time(INAV[5].read(self._blocks(satellite, message, 5)[5]), self._time))
        elif message == D1_MESSAGE and index == 1:
            values = D1[1].read(self._blocks(satellite, message, 1)[1])
            self._suggest(beidou_time(values))
            return self._publish_ionosphere(satellite, values)
        elif message == GLONASS_MESSAGE and index == 5 and self.now[0] != GIVEN_CLOCK:
            stamps = self.satellites[satellite]["stamps"].tolist()
            if stamps[1] == stamps[4] == stamps[5] > 0:
                blocks = self._blocks(satellite, message, 1, 4, 5)
                self._suggest(glonass_time(blocks[1], blocks[4], blocks[5]))
        return []

    def _blocks(self, satellite: int, message: int, *indices: int) -> dict[int, int]:
        """Return the blocks of a satellite, all of its message's or these."""
        count, bits, word_bits = _BLOCKS[message]
        words = self.satellites[satellite]["words"]
        return {i: block_of(words[i].tolist(), bits, word_bits) for i in indices or range(1, count + 1)}

    def _publish(self, satellite: int, message: int) -> list[NavigationData]:
        """Publish what the blocks of a satellite give, if they are whole and not settled."""
        if not set_is_whole(self.satellites, satellite, message, self.now[0]):
            return []
        blocks, time = self._blocks(satellite, message), self._time
        if message == D1_MESSAGE:
            return self._settle(satellite, d1_ephemeris(satellite, blocks))
        if message == D2_MESSAGE:
            return self._publish_d2(satellite, blocks)
        if message == INAV_MESSAGE:
            return self._settle(satellite, inav_ephemeris(satellite, blocks, time))
        assert time is not None, "without a time no set of LNAV or GLONASS is whole"
        if message == LNAV_MESSAGE:
            return self._settle(satellite, lnav_ephemeris(satellite, blocks, time))
        return self._publish_glonass(satellite, blocks, time) if self._is_one_set(satellite, blocks, time) else []

    def _publish_d2(self, satellite: int, blocks: dict[int, int]) -> list[NavigationData]:
        joined = 0
        for block in blocks.values():
            joined = joined << D2_PAGE_BITS | block
        values = D2_EPHEMERIS.read(joined)
        self._suggest(beidou_time(values))
        return self._publish_ionosphere(satellite, values) + self._settle(satellite, d2_ephemeris(satellite, joined))

    def _publish_glonass(self, satellite: int, strings: dict[int, int], time: GpsTime) -> list[NavigationData]:
        state = self.satellites[satellite]
        ephemeris = glonass_ephemeris(satellite, int(state["channel"]), strings, time)
        state["tried_channel"] = state["channel"]
        state["toe_s"] = 0.0 if ephemeris is None else ephemeris.toe.week * SECONDS_PER_WEEK + ephemeris.toe.tow_s
        return self._settle(satellite, ephemeris)

    def _settle(self, satellite: int, ephemeris: Ephemeris | None) -> list[NavigationData]:
        """Publish an ephemeris unless it is none, or differs from the last one at most in its time of transmission."""
        if self._repeats:  # the next one is one of new blocks
            self.satellites[satellite]["held"] = 0
            return [] if ephemeris is None else [ephemeris]
        self.satellites[satellite]["settled"] = 1
        last = self._published.get(satellite)
        if ephemeris is None or (last is not None and _says_the_same(ephemeris, last)):
            return []
        self._published[satellite] = ephemeris
        return [ephemeris]

    def _publish_ionosphere(self, satellite: int, values: dict[str, float]) -> list[NavigationData]:
        """Publish what a satellite says newly; one that repeats what others have replaced since does not bring it back."""
        system = satellite // SATELLITES_PER_SYSTEM
        parameters = klobuchar(system, values)
        repeated, known = self._ionosphere_of.get(satellite) == parameters, self._ionosphere.get(system) == parameters
        self._ionosphere_of[satellite] = parameters
        if repeated or known:
            return []
        self._ionosphere[system] = parameters
        return [parameters]

    def _suggest(self, time: GpsTime | None) -> None:
        """Take a time that the blocks tell, as long as none was given."""
        if time is not None and self.now[0] != GIVEN_CLOCK:
            self._set(time, OWN_CLOCK)

    def _set(self, time: GpsTime, clock: int) -> None:
        self._time, self.now = time, (clock, time.week, time.tow_s)

    def _is_one_set(self, satellite: int, strings: dict[int, int], near: GpsTime) -> bool:
        """Return whether strings 1 to 4 are of one frame, or at least of one interval.

        The data change only at the ends of the interval tb - 15 to tb + 15 minutes (GLONASS ICD 5.1, 4.4, table 4.5).
        """
        state = self.satellites[satellite]
        stamps = state["stamps"][1:5].tolist()
        if len(set(stamps)) == 1:
            return True
        frames = [(stamp - 1 >> 16) * 5 + (stamp - 1 & 0xFF) for stamp in stamps]  # superframe, frame
        tb = moscow_time(GLONASS_STRING[2].unsigned(strings[2], "tb_s") * GLONASS_TB_UNIT_S, near)
        received = zip(state["received_week"][1:5].tolist(), state["received_tow_s"][1:5].tolist(), strict=True)
        in_time = all(week > 0 and abs(GpsTime(week - 1, tow_s) - tb) < _GLONASS_INTERVAL_S for week, tow_s in received)
        return in_time and (max(frames) - min(frames)) * _GLONASS_FRAME_S < _GLONASS_INTERVAL_S


_MEANING: Final = {
    kind: attrgetter(*(field.name for field in fields(kind) if field.name != "transmitted")) for kind in (KeplerEphemeris, GlonassEphemeris)
}


def _says_the_same(a: Ephemeris, b: Ephemeris) -> bool:
    """Return whether two ephemerides differ at most in their times of transmission."""
    return type(a) is type(b) and _MEANING[type(a)](a) == _MEANING[type(b)](b)
