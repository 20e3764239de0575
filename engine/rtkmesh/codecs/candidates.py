"""What the framers of all protocols share: what a candidate for a frame is, and hexadecimal digits."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel

# What a candidate is, where it is not a whole frame (whose length is positive).
NO_FRAME: Final = -1
NEEDS_MORE: Final = -2
BAD_CHECKSUM: Final = -3

NO_DIGIT: Final = 256


def _hex_table() -> NDArray[np.int64]:
    """Return the values of hexadecimal digits by ASCII character, NO_DIGIT where there is none."""
    table = np.full(256, NO_DIGIT, np.int64)
    for value, character in enumerate("0123456789ABCDEF"):
        table[ord(character)] = table[ord(character.lower())] = value
    return table


_HEX = _hex_table()


@kernel
def hex_value(data: bytes, start: int, digits: int) -> int:
    """Return the value of so many hexadecimal digits at ``start`` (all must be there), -1 where one is none."""
    value = 0
    for position in range(start, start + digits):
        digit = int(_HEX[data[position]])
        if digit >= NO_DIGIT:
            return -1
        value = value << 4 | digit
    return value
