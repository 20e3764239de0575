"""RTKRCV's text formats of solutions, byte for byte: llh, xyz, enu, vel_enu, NMEA, status records, marks. Without the engine's kernels."""

from rtkmesh_services.texts.header import TextAbout
from rtkmesh_services.texts.options import TextOptions
from rtkmesh_services.texts.writer import TextWriter

__all__ = ["TextAbout", "TextOptions", "TextWriter"]
