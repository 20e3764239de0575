"""The kernel that writes the lines of satellites of a RINEX 3 or 4 observation file: A1,I2.2, then per type F14.3,I1,I1."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.gnss.signals import SATELLITES_PER_SYSTEM, SYSTEMS

FIELD: Final = 16
SATELLITE_WIDTH: Final = 3
CODE, PHASE, DOPPLER, STRENGTH = range(4)
KINDS: Final = "CLDS"

_DIGITS: Final = 14  # of F14.3
_LARGEST: Final = 9_999_999_999_999  # thousandths that fit, positive and negative
_SMALLEST: Final = -999_999_999_999
_BLANK, _ZERO, _MINUS, _POINT, _LINE_END = (ord(character) for character in " 0-.\n")
_LETTERS: Final = np.array([ord(letter) for letter in SYSTEMS], np.uint8)


@kernel
def write_decimal(out: NDArray[np.uint8], at: int, value: float) -> bool:
    """Write a number as F14.3 to 14 blanks at ``at``; return whether it is there: what is not known, 0 or does not fit stays blank."""
    if np.isnan(value) or abs(value) > 1e11:
        return False
    thousandths = np.int64(np.rint(value * 1e3))
    if thousandths == 0 or thousandths > _LARGEST or thousandths < _SMALLEST:
        return False
    rest, last = abs(thousandths), at + _DIGITS - 1
    for k in range(_DIGITS):
        if k == 3:
            out[last - k] = _POINT
            continue
        out[last - k] = _ZERO + rest % 10
        rest //= 10
        if rest == 0 and k > 3:
            if thousandths < 0:
                out[last - k - 1] = _MINUS
            break
    return True


@kernel
def strength_digit(cn0_dbhz: float) -> int:
    """Return the signal strength 1 to 9 of a C/N0, 0 where it is not known (RINEX 3.05, 5.7)."""
    return 0 if np.isnan(cn0_dbhz) else min(max(int(cn0_dbhz / 6.0), 1), 9)


@kernel
def write_rows(
    satellite: NDArray[np.int16], signal: NDArray[np.int16], flags: NDArray[np.uint8], values: NDArray[np.float64],
    field: NDArray[np.int64], out: NDArray[np.uint8],
) -> tuple[int, int]:  # fmt: skip
    """Write the lines of an epoch to a buffer of blanks; return how many bytes and how many satellites there are.

    ``values`` (4, rows): pseudorange, phase, Doppler, C/N0. ``field`` (system, signal, kind): the place in the line, -1 without one.
    Rows without a place are left out, and so are satellites without any value.
    """
    length, satellites, row = 0, 0, 0
    while row < len(satellite):
        here, begin, end = satellite[row], length, length
        system, number = here // SATELLITES_PER_SYSTEM, here % SATELLITES_PER_SYSTEM
        while row < len(satellite) and satellite[row] == here:
            for kind in range(4):
                place = field[system, signal[row], kind]
                at = begin + SATELLITE_WIDTH + FIELD * place
                if place < 0 or not write_decimal(out, at, values[kind, row]):
                    continue
                width = _DIGITS
                if kind <= PHASE:
                    strength = strength_digit(values[STRENGTH, row])
                    if strength > 0:
                        out[at + _DIGITS + 1], width = _ZERO + strength, _DIGITS + 2
                if kind == PHASE and flags[row] & 3:
                    out[at + _DIGITS], width = _ZERO + (flags[row] & 3), max(width, _DIGITS + 1)
                end = max(end, at + width)
            row += 1
        if end > begin:
            out[begin], out[begin + 1], out[begin + 2] = _LETTERS[system], _ZERO + number // 10, _ZERO + number % 10
            out[end] = _LINE_END
            length, satellites = end + 1, satellites + 1
    return length, satellites
