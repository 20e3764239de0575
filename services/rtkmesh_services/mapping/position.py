"""The configured position of a receiver's antenna, in the engine's frame."""

from math import radians

from rtkmesh.gnss.frames import ecef_from_geodetic
from rtkmesh_schemas.config import IngestTable

Position = tuple[float, float, float]


def known_position(table: IngestTable) -> Position | None:
    """Return the configured ECEF position (m) of a receiver's antenna, or None."""
    return ecef_of(table.position_ecef_m, table.position_llh_deg)


def ecef_of(position_ecef_m: Position | None, position_llh_deg: Position | None) -> Position | None:
    """Return the ECEF position (m) of one that is given in ECEF or as latitude, longitude (deg) and ellipsoidal height (m)."""
    if position_ecef_m is not None or position_llh_deg is None:
        return position_ecef_m
    lat_deg, lon_deg, height_m = position_llh_deg
    x, y, z = ecef_from_geodetic(radians(lat_deg), radians(lon_deg), height_m).tolist()
    return x, y, z
