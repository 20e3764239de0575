"""Bit fields, most significant bit first: kernels on byte arrays, and tables of named fields on whole blocks.

A *block* is a Python integer of a known number of bits; bit 0 is its first (most significant) bit. A ``Layout`` names the
fields of a block; decoders read them and encoders write them from the same table.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel

Bytes = bytes | NDArray[np.uint8]


_MAX_LENGTH: Final = 62  # bits of a number that kernels read
_WORD_BITS: Final = 32


@kernel
def load_words(data: bytes) -> NDArray[np.int64]:
    """Return bytes as words of 32 bits, the last byte's word filled up with zeros, and one word of zeros for ``word_bits`` to run into."""
    whole = len(data) // 4
    words = np.empty(whole + 2, np.int64)
    for i in range(whole):
        at = 4 * i
        words[i] = int(data[at]) << 24 | int(data[at + 1]) << 16 | int(data[at + 2]) << 8 | int(data[at + 3])
    words[whole], words[whole + 1] = 0, 0
    for at in range(4 * whole, len(data)):
        words[whole] |= int(data[at]) << 8 * (3 - at % 4)
    return words


@kernel
def word_bits(words: NDArray[np.int64], position: int, length: int) -> int:
    """Return ``length`` (0 to 32) bits from bit ``position`` of words of 32 bits as an unsigned number. The caller checks the bounds."""
    at = position >> 5
    pair = words[at] << 32 | words[at + 1]  # its sign is cut off below
    return pair >> (63 - (position & 31) - length) >> 1 & (1 << length) - 1


# One part of a field: its bits, and with the last part of a field how its number is made of all of them.
_PART = np.dtype(
    [("first", np.int64), ("length", np.int64), ("last", np.int64), ("sign", np.int64), ("twos", np.int64), ("scale", np.float64)]
)


@kernel
def read_fields(data: bytes, start: int, parts: NDArray[np.void], values: NDArray[np.float64]) -> None:
    """Write the scaled numbers of the fields of a block that begins at byte ``start``; ``parts`` are those of ``_PART``."""
    words, code, field = load_words(data), 0, 0
    for i in range(len(parts)):
        part = parts[i]
        code = code << part["length"] | word_bits(words, 8 * start + part["first"], part["length"])
        if part["last"]:
            if code & part["sign"]:
                code = code - 2 * part["sign"] if part["twos"] else part["sign"] - code
            values[field] = code * part["scale"]
            code, field = 0, field + 1


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


def _part_table(fields: tuple[Field, ...]) -> NDArray[np.void]:
    """Return the parts of all fields as ``read_fields`` wants them."""
    rows: list[tuple[int, int, int, int, int, float]] = []
    for field in fields:
        sign = 0 if field.coding is Coding.UNSIGNED else 1 << (field.length - 1)
        twos = int(field.coding is Coding.TWOS_COMPLEMENT)
        pieces = [piece for first, length in field.parts for piece in _pieces(first, length)]
        rows += [(first, length, int(k == len(pieces) - 1), sign, twos, field.scale) for k, (first, length) in enumerate(pieces)]
    return np.array(rows, _PART)


def _pieces(first: int, length: int) -> list[tuple[int, int]]:
    """Return a part cut into pieces that ``word_bits`` can read."""
    return [(at, min(_WORD_BITS, first + length - at)) for at in range(first, first + length, _WORD_BITS)]


class Layout:
    """The fields of a block of ``bits`` bits. Immutable."""

    def __init__(self, name: str, bits: int, fields: tuple[Field, ...]) -> None:
        self.name, self.bits, self.fields = name, bits, fields
        # By field name: (shift, mask, length) of each part from the block's end, and how to read the joined bits.
        self._parts = {f.name: tuple((bits - first - n, (1 << n) - 1, n) for first, n in f.parts) for f in fields}
        self._sign = {f.name: 0 if f.coding is Coding.UNSIGNED else 1 << (f.length - 1) for f in fields}
        self._names = [f.name for f in fields]
        self._table = _part_table(fields) if all(f.length <= _MAX_LENGTH for f in fields) else None

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
        size = (self.bits + 7) // 8
        return self.read_bytes((block << 8 * size - self.bits).to_bytes(size, "big"))

    def read_bytes(self, data: bytes, start: int = 0) -> dict[str, float]:
        """Return the value of every field of the block that begins at byte ``start`` of ``data``; the caller checks the bounds."""
        if self._table is None:
            raise ValueError(f"{self.name} has fields that are no numbers")
        values = np.empty(len(self._names))
        read_fields(data, start, self._table, values)
        return dict(zip(self._names, values.tolist(), strict=True))

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
