"""The word ``navidata``: the newest ephemeris of each satellite, the ionosphere's coefficients and leap seconds."""

from math import isfinite
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.gnss.ephemeris import KlobucharParameters
from rtkmesh.gnss.signals import satellite_id
from rtkmesh.gnss.time import GpsTime, gps_minus_utc_s
from rtkmesh.models.ephemeris_table import (
    ACCURACY,
    CHANNEL,
    HEALTH,
    IODC,
    IODE,
    KIND,
    SATELLITE,
    STATE_VECTOR,
    TOC_TOW,
    TOC_WEEK,
    TOE_TOW,
    TOE_WEEK,
)
from rtkmesh_services.texts.times import calendar, instant

Row = NDArray[np.float64]

# GPS user range accuracy by index (IS-GPS-200, 20.3.3.3.1.3); Galileo's SISA and others are shown on the same scale.
_URA_M: Final = (2.4, 3.4, 4.85, 6.85, 9.65, 13.65, 24.0, 48.0, 96.0, 192.0, 384.0, 768.0, 1536.0, 3072.0, 6144.0)
_VALID_S: Final = {"G": 7201.0, "R": 1800.0, "E": 14400.0, "C": 21601.0, "J": 7201.0, "S": 360.0, "I": 7201.0}  # RTKLIB's MAXDTOE


def navigation_screen(rows: Row, sent: list[GpsTime], now: GpsTime | None, klobuchar: KlobucharParameters | None) -> str:
    """Return a row per ephemeris (``sent``: when each was sent), then ION and UTC; ``now`` decides which are valid."""
    head = f"SAT   S IOD IOC FRQ A/A SVH{'Toe':>20s}{'Toc':>20s}{'Ttr/Tof':>20s} L2C L2P\n"
    lines = [_line(row, when, now) for row, when in zip(rows, sent, strict=True)]
    alpha, beta = ((0.0,) * 4, (0.0,) * 4) if klobuchar is None else (klobuchar.alpha, klobuchar.beta)
    lines.append("ION:" + "".join(f" {value:9.2E}" for value in (*alpha, *beta)))
    leap_s = 0 if now is None else gps_minus_utc_s(now)
    lines.append(f"UTC:{f' {0.0:9.2E}' * 4}  LEAPS: {leap_s}")  # the terms below a second are in no message that we read
    return head + "".join(f"{line}\n" for line in lines)


def _line(row: Row, sent: GpsTime, now: GpsTime | None) -> str:
    glonass = row[KIND] == STATE_VECTOR
    toe = _time(row, TOE_WEEK, TOE_TOW)
    toc = f"{'-':>19s}" if glonass else _text(_time(row, TOC_WEEK, TOC_TOW))
    health = f"{int(row[HEALTH]):02X}" if glonass else f"{int(row[HEALTH]):03X}"
    issue = 0 if glonass or not isfinite(row[IODC]) else int(row[IODC])
    issues = f"{_whole(row[IODE]):3d} {issue:3d} {_whole(row[CHANNEL]) if glonass else 0:3d} {accuracy_index(float(row[ACCURACY])):3d}"
    times = f"{_text(toe)} {toc} {_text(sent)}"
    return f"{_name(row)}{'OK' if is_valid(row, now) else '-':>4s} {issues} {health:>3s} {times}   0   0"


def is_valid(row: Row, now: GpsTime | None) -> bool:
    """Return whether an ephemeris says that its satellite is healthy, and is not too old or new."""
    return now is not None and row[HEALTH] == 0.0 and abs(now - _time(row, TOE_WEEK, TOE_TOW)) <= _VALID_S[_name(row)[0]]


def accuracy_index(accuracy_m: float) -> int:
    """Return the index of the GPS scale that an accuracy falls into; 15: none is promised."""
    return next((index for index, limit in enumerate(_URA_M) if accuracy_m <= limit), len(_URA_M))


def _name(row: Row) -> str:
    return satellite_id(int(row[SATELLITE]))


def _whole(value: float) -> int:
    return int(value) if isfinite(value) else 0


def _time(row: Row, week: int, tow: int) -> GpsTime:
    return GpsTime.normalized(int(row[week]), float(row[tow]))


def _text(time: GpsTime) -> str:
    return calendar(instant(time.week, time.tow_s), 0)


def navigation_data(rows: Row, sent: list[GpsTime], now: GpsTime | None, klobuchar: KlobucharParameters | None) -> dict[str, Any]:
    """Return the ephemerides by satellite, and the ionosphere's coefficients (None: none came)."""
    return {
        "ephemerides": {_name(row): _facts(row, when, now) for row, when in zip(rows, sent, strict=True)},
        "ionosphere": None if klobuchar is None else {"system": klobuchar.system, "alpha": klobuchar.alpha, "beta": klobuchar.beta},
        "gps_minus_utc_s": None if now is None else gps_minus_utc_s(now),
    }


def _facts(row: Row, sent: GpsTime, now: GpsTime | None) -> dict[str, Any]:
    toe = _time(row, TOE_WEEK, TOE_TOW)
    return {
        "valid": is_valid(row, now),
        "iode": _whole(row[IODE]),
        "health": _whole(row[HEALTH]),
        "accuracy_m": float(row[ACCURACY]),
        "toe": [toe.week, toe.tow_s],
        "transmitted": [sent.week, sent.tow_s],
        **({"channel": _whole(row[CHANNEL])} if row[KIND] == STATE_VECTOR else {"iodc": _whole(row[IODC])}),
    }
