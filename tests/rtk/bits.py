"""Equality of solutions to the last bit."""

from dataclasses import fields, is_dataclass

import numpy as np

from rtkmesh.gnss.time import GpsTime


def same_bits(first: object, second: object) -> bool:
    """Return whether two solutions are equal in every field to the last bit, satellite tables and what else has fields included."""
    for field in fields(first):  # type: ignore[arg-type]
        a, b = getattr(first, field.name), getattr(second, field.name)
        if is_dataclass(a) and not isinstance(a, GpsTime):
            if not same_bits(a, b):
                return False
        elif isinstance(a, np.ndarray | tuple):
            if np.asarray(a).tobytes() != np.asarray(b).tobytes():
                return False
        elif not (a == b or (a != a and b != b)):
            return False
    return True
