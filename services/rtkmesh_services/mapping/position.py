"""The configured position of a receiver's antenna, in the engine's frame."""

from math import radians

from rtkmesh.gnss.frames import ecef_from_geodetic
from rtkmesh_schemas.config import IngestTable


def known_position(table: IngestTable) -> tuple[float, float, float] | None:
    """Return the configured ECEF position (m) of a receiver's antenna, or None."""
    if table.position_ecef_m is not None:
        return table.position_ecef_m
    if table.position_llh_deg is None:
        return None
    lat_deg, lon_deg, height_m = table.position_llh_deg
    x, y, z = ecef_from_geodetic(radians(lat_deg), radians(lon_deg), height_m).tolist()
    return x, y, z
