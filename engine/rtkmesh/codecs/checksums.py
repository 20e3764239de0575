"""Checksums of the framings and of navigation pages. All kernels take ``uint8`` arrays and trust their bounds."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel

Bytes = NDArray[np.uint8]

CRC24Q_POLYNOMIAL: Final = 0x1864CFB  # RTCM 10403.3 4.2, Galileo OS SIS ICD 2.1 5.1.9.4


def _crc24q_table() -> NDArray[np.int64]:
    table = np.zeros(256, np.int64)
    for byte in range(256):
        crc = byte << 16
        for _ in range(8):
            crc <<= 1
            if crc & 0x1000000:
                crc ^= CRC24Q_POLYNOMIAL
        table[byte] = crc
    return table


_CRC24Q = _crc24q_table()


@kernel
def crc24q_range(data: Bytes, start: int, end: int) -> int:
    """Return the CRC-24Q of ``data[start:end]`` (initial value 0)."""
    crc = 0
    for i in range(start, end):
        crc = ((crc << 8) & 0xFFFFFF) ^ int(_CRC24Q[(crc >> 16) ^ int(data[i])])
    return crc


def crc24q(data: Bytes) -> int:
    """Return the CRC-24Q of all bytes."""
    return int(crc24q_range(data, 0, len(data)))


@kernel
def fletcher16_range(data: Bytes, start: int, end: int) -> int:
    """Return the UBX checksum (CK_A + 256 CK_B) of ``data[start:end]``: 8-bit Fletcher, u-blox interface description 3.4."""
    # Sums of up to 8200 bytes of 255 need 35 bits at most, so the reduction modulo 256 can wait until the end.
    a = 0
    b = 0
    for i in range(start, end):
        a += int(data[i])
        b += a
    return (a & 0xFF) | (b & 0xFF) << 8


def fletcher16(data: Bytes) -> int:
    """Return the UBX checksum (CK_A + 256 CK_B) of all bytes (class to end of payload)."""
    return int(fletcher16_range(data, 0, len(data)))


@kernel
def xor8_range(data: Bytes, start: int, end: int) -> int:
    """Return the exclusive or of ``data[start:end]`` (NMEA 0183 5.2.2)."""
    value = 0
    for i in range(start, end):
        value ^= int(data[i])
    return value
