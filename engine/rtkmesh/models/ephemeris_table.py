"""The broadcast ephemerides that are known, packed for kernels, and the choice among their issues.

One row of ``ROW`` float64 holds one issue. Rules of this file: what is kept and what is chosen depends on the *set* of added
ephemerides, never on the order in which they came; every issue is range-checked once, here.
"""

from collections import Counter
from math import isfinite
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel_in_place
from rtkmesh.gnss.constants import SECONDS_PER_WEEK
from rtkmesh.gnss.ephemeris import Ephemeris, GlonassEphemeris, KeplerEphemeris, NavigationMessage
from rtkmesh.gnss.signals import BEIDOU, GALILEO, GLONASS, GPS, MAX_SATELLITE, NAVIC, NO_CHANNEL, QZSS, SATELLITES_PER_SYSTEM
from rtkmesh.gnss.time import GpsTime

# Columns of a row. KIND is 0 where there is no ephemeris (the rest is NaN then), 1 Keplerian, 2 state vector (GLONASS).
KIND, SATELLITE, MESSAGE, TOE_WEEK, TOE_TOW, TOC_WEEK, TOC_TOW, HEALTH, ACCURACY, IODE, CHANNEL = range(11)
AF0, AF1, AF2, DELAY_1, DELAY_2 = range(11, 16)
SQRT_A, ECCENTRICITY, M0, DELTA_N, OMEGA0, OMEGA, OMEGA_DOT, I0, IDOT, CUC, CUS, CRC, CRS, CIC, CIS, IODC = range(16, 32)
POSITION, VELOCITY, ACCELERATION = 16, 19, 22  # first of three columns each, in rows of KIND 2
ROW: Final = 32
NO_EPHEMERIS, KEPLERIAN, STATE_VECTOR = 0.0, 1.0, 2.0

ISSUES_PER_SATELLITE: Final = 320  # a day of Galileo: one issue in 10 minutes, in I/NAV and in F/NAV
UNKNOWN_ACCURACY_M: Final = 500.0  # no accuracy prediction (Galileo NAPA, URA index 15)

# Least half-width of validity around toe (s): the curve fits of the interface documents; BeiDou and GLONASS have no such field.
_HALF_WIDTH_S: Final = {GPS: 7200.0, GLONASS: 1800.0, GALILEO: 14400.0, BEIDOU: 10800.0, QZSS: 7200.0, NAVIC: 7200.0}
_WIDEST_S: Final = 21600.0  # no issue is used farther from its toe, whatever its fit interval says
_SLACK_S: Final = 1.0
_SAME_TOE_S: Final = 60.0  # a GPS upload moves toe by 16 s only to make it differ: then the newer upload wins
_FNAV_PENALTY_S: Final = 3600.0  # F/NAV is chosen when I/NAV is older by more than this
_FNAV: Final = 2.0  # NavigationMessage.FNAV as a row holds it

_TOE_S, _SENT_S, _WIDTH_S, _UNHEALTHY = range(4)  # columns of the table's keys; times in seconds since 1980-01-06

Row = NDArray[np.float64]


class Issues(NamedTuple):
    """All known issues as kernels take them: rows and keys per satellite number, how many there are, GLONASS channels."""

    rows: NDArray[np.float64]
    keys: NDArray[np.float64]
    issues: NDArray[np.int64]
    channel: NDArray[np.int8]


class EphemerisTable:
    """All issues of all satellites; ``add`` puts one in, ``select`` gives the right one per satellite at a time.

    ``added``, ``repeated`` and ``refused`` (by reason) count what ``add`` did.
    """

    def __init__(self) -> None:
        self.added = 0
        self.repeated = 0
        self.refused: Counter[str] = Counter()
        self._rows = np.zeros((MAX_SATELLITE, ISSUES_PER_SATELLITE, ROW))
        self._keys = np.zeros((MAX_SATELLITE, ISSUES_PER_SATELLITE, 4))
        self._count = np.zeros(MAX_SATELLITE, np.int64)
        self._channel = np.full(MAX_SATELLITE, NO_CHANNEL, np.int8)

    def add(self, ephemeris: Ephemeris) -> bool:
        """Take an ephemeris in; False if this issue is known already or refused (the counters say which)."""
        if reason := refusal(ephemeris):
            self.refused[reason] += 1
            return False
        row, key = _pack(ephemeris), _key(ephemeris)
        place, known = self._place(ephemeris.satellite, row, key)
        if known:
            sent = self._keys[ephemeris.satellite, place]
            sent[_SENT_S] = min(sent[_SENT_S], key[_SENT_S])
            self.repeated += 1
            return False
        return self._insert(ephemeris.satellite, place, row, key)

    def withdraw(self, ephemeris: Ephemeris) -> bool:
        """Take out an issue that ``add`` put in; False if it is not there. What a full satellite lost for it does not come back."""
        satellite, count = ephemeris.satellite, int(self._count[ephemeris.satellite])
        place, known = self._place(satellite, _pack(ephemeris), _key(ephemeris))
        if not known:
            return False
        for table in (self._rows[satellite], self._keys[satellite]):
            table[place : count - 1] = table[place + 1 : count].copy()
        self._count[satellite] = count - 1
        return True

    def select(self, satellites: NDArray[np.int16], time: GpsTime, *, include_unhealthy: bool = False) -> Row:
        """Return one row (n, ROW) per satellite: the issue nearest to ``time`` within its validity, newest upload first.

        Where there is none, or the satellite's latest word before ``time`` is that it is unhealthy, KIND is 0 and the rest NaN.
        """
        out = np.empty((len(satellites), ROW))
        select_issues(self.issues, satellites, _seconds(time), include_unhealthy, out)
        return out

    def newest(self) -> tuple[Row, list[GpsTime]]:
        """Return one row (n, ROW) per known satellite, the issue that was sent last, healthy or not, and when each was sent."""
        rows: list[Row] = []
        sent: list[GpsTime] = []
        for satellite in np.flatnonzero(self._count).tolist():
            keys = self._keys[satellite, : self._count[satellite]]
            last = int(np.lexsort((keys[:, _TOE_S], keys[:, _SENT_S]))[-1])
            rows.append(self._rows[satellite, last])
            sent.append(GpsTime.normalized(0, float(keys[last, _SENT_S])))
        return np.array(rows).reshape(-1, ROW), sent

    @property
    def issues(self) -> Issues:
        """What kernels take; not to be written to."""
        return Issues(self._rows, self._keys, self._count, self._channel)

    def channel(self, satellite: int) -> int:
        """Return the GLONASS frequency channel that the latest issue says, or NO_CHANNEL."""
        return int(self._channel[satellite])

    def channels(self, satellites: NDArray[np.int16]) -> NDArray[np.int8]:
        """Return the GLONASS frequency channel per satellite; NO_CHANNEL where not known."""
        return self._channel[satellites]

    def __len__(self) -> int:
        return int(self._count.sum())

    def _place(self, satellite: int, row: Row, key: Row) -> tuple[int, bool]:
        """Return where the row belongs in the order of (toe, content), and whether it is there already."""
        count = int(self._count[satellite])
        toes = self._keys[satellite, :count, _TOE_S]
        toe_s = float(key[_TOE_S])
        place, end = int(np.searchsorted(toes, toe_s, "left")), int(np.searchsorted(toes, toe_s, "right"))
        content = row.tolist()
        while place < end:
            other = self._rows[satellite, place].tolist()
            if other == content:
                return place, True
            if other > content:
                break
            place += 1
        return place, False

    def _insert(self, satellite: int, place: int, row: Row, key: Row) -> bool:
        """Put the row in; of a full satellite the oldest issue goes."""
        rows, keys, count = self._rows[satellite], self._keys[satellite], int(self._count[satellite])
        if count == ISSUES_PER_SATELLITE:
            if place == 0:
                self.refused["older than all kept"] += 1
                return False
            rows[:-1], keys[:-1] = rows[1:].copy(), keys[1:].copy()
            place, count = place - 1, count - 1
        rows[place + 1 : count + 1], keys[place + 1 : count + 1] = rows[place:count].copy(), keys[place:count].copy()
        rows[place], keys[place] = row, key
        self._count[satellite] = count + 1
        self._channel[satellite] = int(rows[count, CHANNEL])
        self.added += 1
        return True


def refusal(ephemeris: Ephemeris) -> str:
    """Return why an ephemeris cannot be one of a navigation satellite; empty if it can."""
    system, number = divmod(ephemeris.satellite, SATELLITES_PER_SYSTEM)
    if number == 0 or system not in _HALF_WIDTH_S or (system == GLONASS) != isinstance(ephemeris, GlonassEphemeris):
        return "satellite"
    if isinstance(ephemeris, GlonassEphemeris):
        return _glonass_refusal(ephemeris)
    return _kepler_refusal(ephemeris)


def _kepler_refusal(e: KeplerEphemeris) -> str:
    """Limits: no field of any interface document can say more, or no navigation satellite can fly it."""
    row = _pack(e)
    if not np.isfinite(row).all() or not isfinite(e.fit_s):
        return "not finite"
    if not 4000.0 <= e.sqrt_a <= 8000.0 or not 0.0 <= e.eccentricity < 0.5:
        return "orbit size or shape"
    if max(abs(row[[M0, OMEGA0, OMEGA, I0]])) > 2.0 * np.pi + 1e-6:
        return "angle"
    if max(abs(row[[DELTA_N, OMEGA_DOT, IDOT]])) > 1e-6 or max(abs(row[[CUC, CUS, CIC, CIS]])) > 1e-3:
        return "rate or correction"
    if max(abs(e.crc_m), abs(e.crs_m)) > 1e5:
        return "rate or correction"
    if abs(e.af0_s) > 0.1 or abs(e.af1) > 1e-6 or abs(e.af2) > 1e-12 or max(map(abs, e.group_delay_s)) > 1e-6:
        return "clock"
    return "" if abs(e.toc - e.toe) <= 2.0 * _WIDEST_S else "clock and orbit apart"


def _glonass_refusal(e: GlonassEphemeris) -> str:
    """Limits: GLONASS ICD 5.1 table 4.5 and the radius of the constellation (25 508 km)."""
    if not np.isfinite(_pack(e)).all():
        return "not finite"
    if not 24.0e6 < np.linalg.norm(e.position_m) < 27.0e6 or not 1.5e3 < np.linalg.norm(e.velocity_mps) < 5.5e3:
        return "orbit size or shape"
    if max(map(abs, e.acceleration_mps2)) > 1e-4:
        return "rate or correction"
    if abs(e.tau_s) > 0.01 or abs(e.gamma) > 1e-8 or abs(e.group_delay_s) > 1e-6:
        return "clock"
    return "" if -7 <= e.channel <= 13 else "channel"


def _pack(e: Ephemeris) -> Row:
    """Return the row of an ephemeris; an accuracy that is not known becomes UNKNOWN_ACCURACY_M."""
    accuracy = e.accuracy_m if isfinite(e.accuracy_m) and e.accuracy_m >= 0.0 else UNKNOWN_ACCURACY_M
    row = np.zeros(ROW)
    if isinstance(e, GlonassEphemeris):
        row[: AF2 + 1] = (
            STATE_VECTOR, e.satellite, NavigationMessage.FDMA, e.toe.week, e.toe.tow_s, e.toe.week, e.toe.tow_s, e.health, accuracy, e.iode,
            e.channel, e.tau_s, e.gamma, 0.0,
        )  # fmt: skip
        row[DELAY_1] = e.group_delay_s
        row[POSITION : ACCELERATION + 3] = (*e.position_m, *e.velocity_mps, *e.acceleration_mps2)
        return row
    row[:] = (
        KEPLERIAN, e.satellite, e.message, e.toe.week, e.toe.tow_s, e.toc.week, e.toc.tow_s, e.health, accuracy, e.iode, NO_CHANNEL,
        e.af0_s, e.af1, e.af2, *e.group_delay_s, e.sqrt_a, e.eccentricity, e.m0_rad, e.delta_n_radps, e.omega0_rad, e.omega_rad,
        e.omega_dot_radps, e.i0_rad, e.idot_radps, e.cuc_rad, e.cus_rad, e.crc_m, e.crs_m, e.cic_rad, e.cis_rad, e.iodc,
    )  # fmt: skip
    return row


def _key(e: Ephemeris) -> Row:
    system = e.satellite // SATELLITES_PER_SYSTEM
    width = _HALF_WIDTH_S[system]
    if isinstance(e, KeplerEphemeris):
        width = min(max(width, e.fit_s), _WIDEST_S)
    # IS-QZSS-PNT, LNAV subframe 1: the last health bit speaks of LEX, later of L1C/B, not of a signal that we use
    unhealthy = e.health & ~1 if system == QZSS else e.health
    return np.array((_seconds(e.toe), _seconds(e.transmitted), width + _SLACK_S, float(unhealthy != 0)))


def _seconds(time: GpsTime) -> float:
    return time.week * SECONDS_PER_WEEK + time.tow_s


@kernel_in_place
def select_issues(issues: Issues, satellites: NDArray[np.int16], time_s: float, include_unhealthy: bool, out: NDArray[np.float64]) -> None:
    """Write one row (n, ROW) per satellite as ``EphemerisTable.select`` says; ``time_s`` counts from the start of GPS time."""
    for i in range(len(satellites)):
        satellite, best = int(satellites[i]), -1
        if 0 <= satellite < len(issues.issues):
            keys, count = issues.keys[satellite], int(issues.issues[satellite])
            best = _best_issue(issues.rows[satellite], keys, count, time_s)
            if best >= 0 and not include_unhealthy and _withdrawn(keys, count, best, time_s):
                best = -1
        for k in range(out.shape[1]):
            out[i, k] = issues.rows[satellite, best, k] if best >= 0 else np.nan
        if best < 0:
            out[i, 0] = 0.0


@kernel_in_place
def _first_in_reach(keys: NDArray[np.float64], count: int, time_s: float) -> int:
    """Return the first issue (in the order of toe) that any validity could reach from ``time_s``."""
    low, high = 0, count
    while low < high:
        middle = (low + high) // 2
        if keys[middle, 0] < time_s - _WIDEST_S - _SLACK_S:
            low = middle + 1
        else:
            high = middle
    return low


@kernel_in_place
def _best_issue(rows: NDArray[np.float64], keys: NDArray[np.float64], count: int, time_s: float) -> int:
    """Return the issue nearest to ``time_s``; among those with practically one toe the last sent; -1 where none is valid."""
    first, nearest, least = _first_in_reach(keys, count, time_s), -1, np.inf
    for j in range(first, count):
        distance = abs(keys[j, 0] - time_s)
        cost = distance + (_FNAV_PENALTY_S if rows[j, 2] == _FNAV else 0.0)
        if distance <= keys[j, 2] and cost <= least:
            nearest, least = j, cost
    best = nearest
    for j in range(first, count):
        near = abs(keys[j, 0] - keys[nearest, 0]) <= _SAME_TOE_S and rows[j, 2] == rows[nearest, 2]
        if nearest >= 0 and near and abs(keys[j, 0] - time_s) <= keys[j, 2] and keys[j, 1] > keys[best, 1]:
            best = j
    return best


@kernel_in_place
def _withdrawn(keys: NDArray[np.float64], count: int, best: int, time_s: float) -> bool:
    """Return whether the chosen issue, or the last one sent before ``time_s``, says that the satellite is unhealthy."""
    last = best
    for j in range(_first_in_reach(keys, count, time_s), count):
        if abs(keys[j, 0] - time_s) <= keys[j, 2] and keys[last, 1] < keys[j, 1] <= time_s:
            last = j
    return keys[best, 3] != 0.0 or keys[last, 3] != 0.0
