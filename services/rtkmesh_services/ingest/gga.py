"""The sentence by which a client tells a caster where it is."""

from datetime import UTC, datetime

from rtkmesh.codecs.nmea_encode import Position, gga
from rtkmesh_services.ntrip.place import Place


def gga_sentence(place: Place, utc_s: float) -> str:
    """Return GGA for a place, with line end. Quality 1, 10 satellites, HDOP 1: casters take nothing less; geoid separation 0."""
    return gga(datetime.fromtimestamp(utc_s, UTC), Position(*place), 1, 10, hdop=1.0, talker="GP")
