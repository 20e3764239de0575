"""Values to logs of NovAtel receivers: RANGE and RANGECMP, ephemerides, ionosphere, BESTPOS, HEADING and HEADING2 (OEM7 manual v15C)."""

from typing import Final

from rtkmesh.codecs.checksums import crc32
from rtkmesh.codecs.framing_novatel import LONG_HEADER, NOVATEL_LOGS
from rtkmesh.codecs.novatel import BESTPOS, HEADING, HEADING2, IONOSPHERE, NOVATEL
from rtkmesh.codecs.novatel_ephemeris import (
    BEIDOU_FIELDS,
    BEIDOU_NAMES,
    FNAV_FIELDS,
    FNAV_NAMES,
    INAV_FIELDS,
    INAV_NAMES,
    SUBFRAME_BYTES,
    SUBFRAMES,
)
from rtkmesh.codecs.novatel_logs import HEADER
from rtkmesh.codecs.subframes_encode import lnav_subframes
from rtkmesh.codecs.unicore_encode import (
    compressed_rows,
    counted,
    encoded_ephemeris,
    galileo_values,
    heading_values,
    kepler_values,
    observation_rows,
    position_values,
    time_of,
)
from rtkmesh.codecs.unicore_ephemeris import QZSS_PRN_OFFSET
from rtkmesh.codecs.unicore_logs import Value
from rtkmesh.gnss.ephemeris import Ephemeris, KeplerEphemeris, KlobucharParameters, NavigationMessage, ReceiverFix
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.receiver import ReceiverHeading
from rtkmesh.gnss.signals import BEIDOU, GALILEO, QZSS, SATELLITES_PER_SYSTEM
from rtkmesh.gnss.time import GpsTime

_NUMBERS: Final = {name: number for number, name in NOVATEL_LOGS.items()}
_PORT, _FINE_STEERING, _SOFTWARE = 32, 180, 16809
_FIT_INTERVAL: Final = bytes(4)  # behind the fields of QZSSEPHEMERIS
_UTC_BYTES: Final = 44  # of IONUTC
_SIGNAL_CHANNEL: Final = bytes(4)  # behind the subframes of QZSSRAWEPHEM


def binary_log(name: str, time: GpsTime, body: bytes, source: int = 0) -> bytes:
    """Return a binary log; ``source`` 1 is the second antenna. Its header tells whole milliseconds."""
    header = HEADER.pack(
        b"\xaa\x44\x12", LONG_HEADER, _NUMBERS[name], source, _PORT, len(body), 0, 0, _FINE_STEERING, time.week, round(time.tow_s * 1e3),
        0, 0, _SOFTWARE,
    )  # fmt: skip
    return header + body + crc32(header + body).to_bytes(4, "little")


def ascii_log(name: str, time: GpsTime, body: str) -> bytes:
    """Return an ASCII log."""
    text = f"{name},COM1,0,50.0,FINESTEERING,{time.week},{time.tow_s:.3f},02000020,5103,{_SOFTWARE};{body}"
    return f"#{text}*{crc32(text.encode()):08x}\r\n".encode()


def encode_observations(epoch: Epoch, source: int = 0) -> bytes:
    """Return RANGE of an epoch; signals that NovAtel has no number for are left out."""
    return binary_log("RANGE", epoch.time, counted([row.tobytes() for row in observation_rows(epoch, NOVATEL)]), source)


def encode_observations_ascii(epoch: Epoch) -> bytes:
    """Return RANGEA of an epoch."""
    rows = observation_rows(epoch, NOVATEL)
    words = [
        f"{r['prn']},{r['frequency']},{r['pseudorange_m']:.3f},{r['pseudorange_sigma']:.3f},{r['range_cyc']:.6f},{r['phase_sigma']:.3f},"
        f"{r['doppler_hz']:.3f},{r['cn0']:.1f},{r['lock_s']:.3f},{int(r['status']):08x}"
        for r in rows
    ]
    return ascii_log("RANGEA", epoch.time, ",".join([str(len(rows)), *words]))


def encode_compressed(epoch: Epoch, source: int = 0) -> bytes:
    """Return RANGECMP of an epoch."""
    return binary_log("RANGECMP", epoch.time, counted(compressed_rows(epoch, NOVATEL)), source)


def encode_compressed_ascii(epoch: Epoch) -> bytes:
    """Return RANGECMPA of an epoch: each measurement in hexadecimal."""
    rows = compressed_rows(epoch, NOVATEL)
    return ascii_log("RANGECMPA", epoch.time, ",".join([str(len(rows)), *(row.hex() for row in rows)]))


def encode_raw_ephemeris(e: KeplerEphemeris, sent: GpsTime) -> bytes:
    """Return RAWEPHEM (GPS) or QZSSRAWEPHEM of an LNAV ephemeris, as of a time; ValueError where a value does not fit its field."""
    system, number = divmod(e.satellite, SATELLITES_PER_SYSTEM)
    subframes = lnav_subframes(e, e.transmitted)
    is_qzss = system == QZSS
    head = (number + is_qzss * QZSS_PRN_OFFSET, e.toe.week, int(e.toe.tow_s))
    body = b"".join([*(value.to_bytes(4, "little") for value in head), *(_without_parity(subframes[i]) for i in SUBFRAMES)])
    return binary_log("QZSSRAWEPHEM" if is_qzss else "RAWEPHEM", sent, body + _SIGNAL_CHANNEL * is_qzss)


def _without_parity(block: int) -> bytes:
    data = 0
    for word in range(10):
        data = data << 24 | block >> (30 * (9 - word) + 6) & 0xFFFFFF
    return data.to_bytes(SUBFRAME_BYTES, "big")


def encode_ephemeris(e: Ephemeris, sent: GpsTime) -> bytes:
    """Return GPSEPHEM, QZSSEPHEMERIS, GLOEPHEMERIS, GALEPHEMERIS or BDSEPHEMERIS of an ephemeris as of a time."""
    if isinstance(e, KeplerEphemeris) and e.satellite // SATELLITES_PER_SYSTEM == BEIDOU:
        values: dict[str, Value] = {**kepler_values(e), "ura_m": e.accuracy_m}
        for name in ("toe_s", "toc_s"):
            values[name] = round(float(values[name]))
        return binary_log("BDSEPHEMERIS", sent, BEIDOU_FIELDS.pack(*(values.get(name, getattr(e, name, 0)) for name in BEIDOU_NAMES)))
    name, body = encoded_ephemeris(e)
    names = {"GPSEPH": "GPSEPHEM", "QZSSEPH": "QZSSEPHEMERIS", "GLOEPH": "GLOEPHEMERIS", "GALEPH": "GALEPHEMERIS"}
    return binary_log(names[name], sent, body + _FIT_INTERVAL * (name == "QZSSEPH"))


def encode_galileo(e: KeplerEphemeris, sent: GpsTime) -> bytes:
    """Return GALINAVEPHEMERIS or GALFNAVEPHEMERIS of a Galileo ephemeris."""
    if e.satellite // SATELLITES_PER_SYSTEM != GALILEO:
        raise ValueError("not of Galileo")
    is_inav = e.message is NavigationMessage.INAV
    name, names, fields = ("GALINAVEPHEMERIS", INAV_NAMES, INAV_FIELDS) if is_inav else ("GALFNAVEPHEMERIS", FNAV_NAMES, FNAV_FIELDS)
    values = galileo_values(e)
    return binary_log(name, sent, fields.pack(*(values.get(field, getattr(e, field, 0)) for field in names)))


def encode_ionosphere(parameters: KlobucharParameters, sent: GpsTime) -> bytes:
    """Return IONUTC of GPS parameters; those of UTC are zero."""
    return binary_log("IONUTC", sent, IONOSPHERE.pack(*parameters.alpha, *parameters.beta) + bytes(_UTC_BYTES))


def encode_position(fix: ReceiverFix) -> bytes:
    """Return BESTPOS of a fix, whose time must be known; heights are told above the ellipsoid (no undulation)."""
    return binary_log("BESTPOS", time_of(fix, "BESTPOS"), BESTPOS.pack(*position_values(fix)))


def encode_heading(heading: ReceiverHeading, name: str = "HEADING2") -> bytes:
    """Return HEADING2 or HEADING of a heading, whose time must be known."""
    fields, stations = (HEADING2, (heading.station, "")) if name == "HEADING2" else (HEADING, (heading.station,))
    return binary_log(name, time_of(heading, name), fields.pack(*heading_values(heading, *stations)))
