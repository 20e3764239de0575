"""Bit fields, most significant bit first: kernels on byte arrays, and tables of named fields on whole blocks.

A *block* is a Python integer of a known number of bits; bit 0 is its first (most significant) bit. A ``Layout`` names the
fields of a block; decoders read them and encoders write them from the same table.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel

Bytes = NDArray[np.uint8]


@kernel
def unsigned_bits(buffer: Bytes, position: int, length: int) -> int:
    """Return ``length`` (0 to 62) bits from bit ``position`` as an unsigned number. The caller checks the bounds."""
    value = 0
    byte = position >> 3
    offset = position & 7
    left = length
    while left > 0:
        take = min(8 - offset, left)
        chunk = (int(buffer[byte]) >> (8 - offset - take)) & ((1 << take) - 1)
        value = (value << take) | chunk
        left -= take
        offset = 0
        byte += 1
    return value


@kernel
def signed_bits(buffer: Bytes, position: int, length: int) -> int:
    """Return ``length`` (1 to 62) bits from bit ``position`` as a two's complement number."""
    value = unsigned_bits(buffer, position, length)
    return value - (1 << length) if value >> (length - 1) else value


@kernel
def sign_magnitude_bits(buffer: Bytes, position: int, length: int) -> int:
    """Return ``length`` (2 to 62) bits from bit ``position`` as sign and magnitude (GLONASS)."""
    magnitude = unsigned_bits(buffer, position + 1, length - 1)
    return -magnitude if unsigned_bits(buffer, position, 1) else magnitude


class BitWriter:
    """Bits appended most significant first."""

    def __init__(self) -> None:
        self._value = 0
        self._length = 0

    def __len__(self) -> int:
        return self._length

    def unsigned(self, value: int, length: int) -> None:
        """Append an unsigned number; ValueError if it does not fit."""
        self._append(Coding.UNSIGNED.encode(value, length), length)

    def signed(self, value: int, length: int) -> None:
        """Append a two's complement number; ValueError if it does not fit."""
        self._append(Coding.TWOS_COMPLEMENT.encode(value, length), length)

    def sign_magnitude(self, value: int, length: int) -> None:
        """Append sign and magnitude; ValueError if it does not fit."""
        self._append(Coding.SIGN_MAGNITUDE.encode(value, length), length)

    def _append(self, code: int, length: int) -> None:
        self._value = (self._value << length) | code
        self._length += length

    def to_bytes(self) -> bytes:
        """Return all bits so far, the last byte filled with zeros."""
        fill = -self._length % 8
        return (self._value << fill).to_bytes((self._length + fill) // 8, "big")


class Coding(Enum):
    """How a number stands in its bits."""

    UNSIGNED = 0
    TWOS_COMPLEMENT = 1
    SIGN_MAGNITUDE = 2

    def decode(self, code: int, length: int) -> int:
        """Return the number that the bits mean."""
        sign = 1 << (length - 1)
        if self is Coding.UNSIGNED or not code & sign:
            return code
        return code - 2 * sign if self is Coding.TWOS_COMPLEMENT else sign - code

    def encode(self, number: int, length: int) -> int:
        """Return the bits of a number; ValueError if it does not fit."""
        limit = 1 << (length if self is Coding.UNSIGNED else length - 1)
        lowest = {Coding.UNSIGNED: 0, Coding.TWOS_COMPLEMENT: -limit, Coding.SIGN_MAGNITUDE: 1 - limit}[self]
        if not lowest <= number < limit:
            raise ValueError(f"{number} does not fit in {length} bits ({self.name.lower()})")
        if number >= 0:
            return number
        return number + 2 * limit if self is Coding.TWOS_COMPLEMENT else limit - number


@dataclass(frozen=True, slots=True)
class Field:
    """One number of a block: ``parts`` are (first bit, length), most significant part first; value = number * ``scale``."""

    name: str
    parts: tuple[tuple[int, int], ...]
    scale: float = 1.0
    coding: Coding = Coding.UNSIGNED

    @property
    def length(self) -> int:
        """Number of bits of all parts."""
        return sum(length for _, length in self.parts)


class Layout:
    """The fields of a block of ``bits`` bits. Immutable."""

    def __init__(self, name: str, bits: int, fields: tuple[Field, ...]) -> None:
        self.name, self.bits, self.fields = name, bits, fields
        # By field name: (shift, mask, length) of each part from the block's end, and how to read the joined bits.
        self._parts = {f.name: tuple((bits - first - n, (1 << n) - 1, n) for first, n in f.parts) for f in fields}
        self._sign = {f.name: 0 if f.coding is Coding.UNSIGNED else 1 << (f.length - 1) for f in fields}

    def number(self, block: int, field: Field) -> int:
        """Return the unscaled number of a field."""
        code = 0
        for shift, mask, length in self._parts[field.name]:
            code = code << length | block >> shift & mask
        if not code & self._sign[field.name]:
            return code
        return field.coding.decode(code, field.length)

    def unsigned(self, block: int, name: str) -> int:
        """Return the unscaled bits of a field by name, without regard to its sign."""
        code = 0
        for shift, mask, length in self._parts[name]:
            code = code << length | block >> shift & mask
        return code

    def read(self, block: int) -> dict[str, float]:
        """Return the value of every field, scaled to its unit."""
        return {field.name: self.number(block, field) * field.scale for field in self.fields}

    def write(self, values: Mapping[str, float], block: int = 0) -> int:
        """Return ``block`` with the fields named in ``values`` set (rounded to their resolution); ValueError if one does not fit."""
        for field in self.fields:
            if field.name in values:
                value = values[field.name]
                number = value if isinstance(value, int) and field.scale == 1.0 else round(value / field.scale)
                block = self._set(block, field, number)
        return block

    def _set(self, block: int, field: Field, number: int) -> int:
        code, left = field.coding.encode(number, field.length), field.length
        for shift, mask, length in self._parts[field.name]:
            left -= length
            block = block & ~(mask << shift) | ((code >> left) & mask) << shift
        return block
