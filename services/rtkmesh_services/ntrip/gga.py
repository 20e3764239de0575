"""The sentence by which a client tells a caster where it is (NMEA 0183, GGA)."""

from time import gmtime, strftime
from typing import NamedTuple


class Place(NamedTuple):
    """Where a rover is: degrees, metres above the ellipsoid."""

    lat_deg: float
    lon_deg: float
    height_m: float = 0.0


def gga_sentence(place: Place, utc_s: float) -> str:
    """Return GGA for a place, with line end. Quality 1, 10 satellites, HDOP 1: casters take nothing less; geoid separation 0."""
    lat, lon = _angle(abs(place.lat_deg), 2), _angle(abs(place.lon_deg), 3)
    time = f"{strftime('%H%M%S', gmtime(utc_s))}.{int(utc_s % 1.0 * 100):02d}"
    north, east = "N" if place.lat_deg >= 0.0 else "S", "E" if place.lon_deg >= 0.0 else "W"
    body = f"GPGGA,{time},{lat},{north},{lon},{east},1,10,1.0,{place.height_m:.3f},M,0.000,M,,"
    check = 0
    for byte in body.encode():
        check ^= byte
    return f"${body}*{check:02X}\r\n"


def _angle(angle_deg: float, digits: int) -> str:
    minutes_e7 = round(angle_deg * 60e7)
    return f"{minutes_e7 // 600_000_000:0{digits}d}{minutes_e7 % 600_000_000 / 1e7:010.7f}"
