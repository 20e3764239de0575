"""Navigation blocks, as they arrive, to ephemerides: gathers sets, waits for a time, publishes each new set once.

The 10-bit week of LNAV and the day of GLONASS need a time near the transmission. It comes from the caller (``set_time``: the
receiver's own epochs) or, until then, from messages that carry a full date (Galileo, BeiDou, GLONASS with string 5). Complete
sets wait for it. When the caller's time is first known or jumps by more than an hour, all complete sets are dated anew.
"""

from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Final

import numpy as np

from rtkmesh.codecs.bits import Layout
from rtkmesh.codecs.checksums import crc24q
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
from rtkmesh.codecs.subframes import (
    BEIDOU_HEADER,
    BEIDOU_PREAMBLE,
    D1,
    D2_EPHEMERIS,
    D2_PAGE,
    D2_PAGE_BITS,
    GLONASS_HEADER,
    GLONASS_STRING,
    INAV,
    INAV_HEADER,
    INAV_PAGE,
    LNAV,
    LNAV_HEADER,
    LNAV_PREAMBLE,
    glonass_check_bits,
)  # fmt: skip
from rtkmesh.gnss.constants import SECONDS_PER_WEEK
from rtkmesh.gnss.ephemeris import Ephemeris, KlobucharParameters
from rtkmesh.gnss.signals import GPS, QZSS, SATELLITES_PER_SYSTEM
from rtkmesh.gnss.time import GpsTime

NavigationData = Ephemeris | KlobucharParameters

_TIME_JUMP_S: Final = 3600.0
_GLONASS_INTERVAL_S: Final = 900.0 - 60.0  # the time of reception is known to some seconds
_GLONASS_FRAME_S: Final = 30.0
_IONOSPHERE_PAGES: Final = {GPS: (1, 56), QZSS: (3, 56)}  # data id and page id (IS-GPS-200N 20.3.3.5.1, IS-QZSS-PNT 5.5.2)


class Refusal(Enum):
    """Why a block was not used (data faults are values)."""

    PREAMBLE = "preamble"
    CHECKSUM = "checksum"
    ALERT_PAGE = "alert page"
    RANGE = "range"


@dataclass(slots=True)
class _Satellite:
    """The newest blocks of one satellite; ``stamps`` say when, or in which frame, each was sent, ``received`` at what time."""

    blocks: dict[int, int] = field(default_factory=dict[int, int])
    stamps: dict[int, int] = field(default_factory=dict[int, int])
    received: dict[int, GpsTime | None] = field(default_factory=dict[int, "GpsTime | None"])
    channel: int = 0
    settled: bool = False  # these blocks have been tried, and their ephemeris, if any, is published
    published: Ephemeris | None = None


def _without(layout: Layout, *names: str) -> int:
    """Return the mask of a block that hides the named fields."""
    hidden = Layout(layout.name, layout.bits, tuple(f for f in layout.fields if f.name in names))
    return hidden.write({f.name: (1 << f.length) - 1 for f in hidden.fields}) ^ ((1 << layout.bits) - 1)


_ALL_BITS: Final = -1
_LNAV_CONTENT: Final = (1 << 240) - 1  # words 3 to 10: the first two are the same in meaning whenever they are sent
_BEIDOU_CONTENT: Final = ((1 << 258) - 1) & ~(0xFF << 240)  # without preamble, time and the parity of words 1 and 2
_WORD5_CONTENT: Final = _without(INAV[5], "tow_s")
_STRING1_CONTENT: Final = _without(GLONASS_STRING[1], "tk_hours", "tk_minutes", "tk_half_minutes") & ~0xFF  # nor the check bits


class NavigationDecoder:
    """Turns the navigation blocks of one stream into ephemerides and ionosphere parameters."""

    def __init__(self, approximate_time: GpsTime | None = None) -> None:
        self._time = approximate_time
        self._time_is_given = approximate_time is not None
        self._satellites: dict[tuple[int, str], _Satellite] = {}
        self._ionosphere: dict[int, KlobucharParameters] = {}  # by system: published last
        self._ionosphere_of: dict[int, KlobucharParameters] = {}  # by satellite: said last

    @property
    def time(self) -> GpsTime | None:
        """The newest time that the weeks are resolved by."""
        return self._time

    def set_time(self, time: GpsTime) -> list[NavigationData]:
        """Take a time of the receiver; return what had waited for it."""
        known, self._time = self._time if self._time_is_given else None, time
        self._time_is_given = True
        if known is not None and abs(time - known) < _TIME_JUMP_S:
            return []
        publishers = {
            "lnav": self._publish_lnav,
            "inav": self._publish_inav,
            "d1": self._publish_d1,
            "d2": self._publish_d2,
            "glonass": self._publish_glonass,
        }
        found: list[NavigationData] = []
        for (satellite, message), state in self._satellites.items():
            state.settled = False
            found += publishers[message](satellite, state)
        return found

    def lnav(self, satellite: int, block: int) -> list[NavigationData] | Refusal:
        """Take one GPS or QZSS LNAV subframe (300 bits, parity included)."""
        if LNAV_HEADER.unsigned(block, "preamble") != LNAV_PREAMBLE:
            return Refusal.PREAMBLE
        subframe = LNAV_HEADER.unsigned(block, "subframe")
        if subframe == 4:
            return self._lnav_ionosphere(satellite, block)
        if subframe not in (1, 2, 3):
            return []
        state = self._store(satellite, "lnav", subframe, block, 0, _LNAV_CONTENT)
        return [] if state.settled else self._publish_lnav(satellite, state)

    def _publish_lnav(self, satellite: int, state: _Satellite) -> list[NavigationData]:
        if state.settled or len(state.blocks) < 3 or self._time is None:
            return []
        return self._publish(state, lnav_ephemeris(satellite, state.blocks, self._time))

    def _lnav_ionosphere(self, satellite: int, block: int) -> list[NavigationData]:
        page = LNAV[4].unsigned(block, "data_id"), LNAV[4].unsigned(block, "page_id")
        if _IONOSPHERE_PAGES.get(satellite // SATELLITES_PER_SYSTEM) != page:
            return []
        return self._publish_ionosphere(satellite, LNAV[4].read(block))

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

    def inav(self, satellite: int, page: int) -> list[NavigationData] | Refusal:
        """Take one Galileo I/NAV page, even and odd part, as u-blox lays them out (256 bits, see ``INAV_PAGE``)."""
        if INAV_PAGE.unsigned(page, "even_odd_0") or not INAV_PAGE.unsigned(page, "even_odd_1"):
            return Refusal.PREAMBLE
        if INAV_PAGE.unsigned(page, "alert_0") or INAV_PAGE.unsigned(page, "alert_1"):
            return Refusal.ALERT_PAGE
        word = INAV_PAGE.unsigned(page, "data")
        if INAV_HEADER.unsigned(word, "word") > 5:
            return []
        # The 196 bits are filled up in front, where zeros leave the CRC as it is.
        covered = INAV_PAGE.unsigned(page, "covered").to_bytes(25, "big")
        if crc24q(np.frombuffer(covered, np.uint8)) != INAV_PAGE.unsigned(page, "crc"):
            return Refusal.CHECKSUM
        return self.inav_word(satellite, word)

    def inav_word(self, satellite: int, word: int) -> list[NavigationData]:
        """Take the 128 data bits of one verified I/NAV word."""
        kind = INAV_HEADER.unsigned(word, "word")
        if kind == 0 and INAV[0].unsigned(word, "time") == 2:
            self._suggest_time(inav_time(INAV[0].read(word), self._time))
        if kind not in (1, 2, 3, 4, 5):
            return []
        if kind == 5 and not self._time_is_given:
            self._suggest_time(inav_time(INAV[5].read(word), self._time))
        state = self._store(satellite, "inav", kind, word, 0, _WORD5_CONTENT if kind == 5 else _ALL_BITS)
        return [] if state.settled else self._publish_inav(satellite, state)

    def _publish_inav(self, satellite: int, state: _Satellite) -> list[NavigationData]:
        if state.settled or len(state.blocks) < 5:
            return []
        return self._publish(state, inav_ephemeris(satellite, state.blocks, self._time))

    def d1(self, satellite: int, block: int) -> list[NavigationData] | Refusal:
        """Take one BeiDou D1 subframe (300 bits, parity included)."""
        if BEIDOU_HEADER.unsigned(block, "preamble") != BEIDOU_PREAMBLE:
            return Refusal.PREAMBLE
        subframe = BEIDOU_HEADER.unsigned(block, "subframe")
        if subframe not in (1, 2, 3):
            return []
        state = self._store(satellite, "d1", subframe, block, BEIDOU_HEADER.unsigned(block, "sow_s"), _BEIDOU_CONTENT)
        if state.settled:
            return []
        found: list[NavigationData] = []
        if subframe == 1:
            values = D1[1].read(block)
            self._suggest_time(beidou_time(values))
            found += self._publish_ionosphere(satellite, values)
        return found + self._publish_d1(satellite, state)

    def _publish_d1(self, satellite: int, state: _Satellite) -> list[NavigationData]:
        if state.settled or len(state.blocks) < 3 or not _consecutive(state.stamps, 3, 6):
            return []
        return self._publish(state, d1_ephemeris(satellite, state.blocks))

    def d2(self, satellite: int, block: int) -> list[NavigationData] | Refusal:
        """Take one BeiDou D2 subframe (300 bits, parity included)."""
        if BEIDOU_HEADER.unsigned(block, "preamble") != BEIDOU_PREAMBLE:
            return Refusal.PREAMBLE
        if BEIDOU_HEADER.unsigned(block, "subframe") != 1:
            return []
        block >>= 300 - D2_PAGE_BITS
        page = D2_PAGE.unsigned(block, "page")
        if not 1 <= page <= 10:
            return Refusal.RANGE
        state = self._store(satellite, "d2", page, block, D2_PAGE.unsigned(block, "sow_s"), _BEIDOU_CONTENT >> (300 - D2_PAGE_BITS))
        return [] if state.settled else self._publish_d2(satellite, state)

    def _publish_d2(self, satellite: int, state: _Satellite) -> list[NavigationData]:
        if state.settled or len(state.blocks) < 10 or not _consecutive(state.stamps, 10, 3):
            return []
        joined = 0
        for page in range(1, 11):
            joined = joined << D2_PAGE_BITS | state.blocks[page]
        values = D2_EPHEMERIS.read(joined)
        self._suggest_time(beidou_time(values))
        return self._publish_ionosphere(satellite, values) + self._publish(state, d2_ephemeris(satellite, joined))

    def glonass(self, satellite: int, channel: int, string: int, frame: int) -> list[NavigationData] | Refusal:
        """Take one GLONASS string (85 bits, check bits included); ``frame`` is equal for the strings of one frame, or 0."""
        number = GLONASS_HEADER.unsigned(string, "string")
        if number not in (1, 2, 3, 4, 5):
            return []
        if glonass_check_bits(string >> 8) != string & 0xFF:
            return Refusal.CHECKSUM
        state = self._store(satellite, "glonass", number, string, frame, _STRING1_CONTENT if number == 1 else _ALL_BITS)
        state.channel, state.received[number] = channel, self._time if self._time_is_given else None
        if number == 1 and frame == 0:  # a new frame begins: what is left of others must not complete it
            state.stamps = {1: 0}
        if state.settled:
            return []
        if number == 5 and not self._time_is_given and _same_frame(state, (1, 4, 5)):
            time = glonass_time(state.blocks[1], state.blocks[4], string)
            if time is not None:
                self._suggest_time(time)
        return self._publish_glonass(satellite, state)

    def _publish_glonass(self, satellite: int, state: _Satellite) -> list[NavigationData]:
        if state.settled or self._time is None:
            return []
        if not (_same_frame(state, (1, 2, 3, 4)) or _same_interval(state, self._time)):
            return []
        return self._publish(state, glonass_ephemeris(satellite, state.channel, state.blocks, self._time))

    def _suggest_time(self, time: GpsTime) -> None:
        if not self._time_is_given:
            self._time = time

    def _store(self, satellite: int, message: str, index: int, block: int, stamp: int, content: int) -> _Satellite:
        state = self._satellites.setdefault((satellite, message), _Satellite())
        if (state.blocks.get(index, ~block) ^ block) & content:
            state.settled = False
        state.blocks[index], state.stamps[index] = block, stamp
        return state

    def _publish(self, state: _Satellite, ephemeris: Ephemeris | None) -> list[NavigationData]:
        """Publish an ephemeris unless it is none, or differs from the last one at most in its time of transmission."""
        state.settled = True
        last = state.published
        if ephemeris is None or (last is not None and replace(ephemeris, transmitted=last.transmitted) == last):
            return []
        state.published = ephemeris
        return [ephemeris]


def _consecutive(stamps: dict[int, int], count: int, step_s: int) -> bool:
    """Return whether blocks 1 to ``count`` were sent one after the other, ``step_s`` apart."""
    return all((stamps[i] - stamps[1] - step_s * (i - 1)) % SECONDS_PER_WEEK == 0 for i in range(2, count + 1))


def _same_frame(state: _Satellite, strings: tuple[int, ...]) -> bool:
    stamps = state.stamps
    return all(i in stamps and stamps[i] == stamps[strings[0]] for i in strings)


def _same_interval(state: _Satellite, near: GpsTime) -> bool:
    """Return whether strings 1 to 4, though of several frames, belong to one set.

    The data change only at the ends of the interval tb - 15 to tb + 15 minutes (GLONASS ICD 5.1, 4.4, table 4.5).
    """
    if not all(state.stamps.get(i) for i in (1, 2, 3, 4)):
        return False
    frames = [(state.stamps[i] >> 16) * 5 + (state.stamps[i] & 0xFF) for i in (1, 2, 3, 4)]  # superframe, frame
    tb = moscow_time(GLONASS_STRING[2].read(state.blocks[2])["tb_s"], near)
    received = [state.received.get(i) for i in (1, 2, 3, 4)]
    in_time = all(time is not None and abs(time - tb) < _GLONASS_INTERVAL_S for time in received)
    return in_time and (max(frames) - min(frames)) * _GLONASS_FRAME_S < _GLONASS_INTERVAL_S
