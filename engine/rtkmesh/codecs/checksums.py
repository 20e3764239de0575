"""Checksums of the framings and of navigation pages. All kernels trust their bounds."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel

Bytes = bytes | NDArray[np.uint8]

CRC24Q_POLYNOMIAL: Final = 0x1864CFB  # RTCM 10403.3 4.2, Galileo OS SIS ICD 2.1 5.1.9.4
CRC16_POLYNOMIAL: Final = 0x1021  # CCITT, initial value 0: mosaic-X5 reference guide 4.14, 4.1.1
CRC32_POLYNOMIAL: Final = (
    0xEDB88320  # reflected: that of IEEE 802.3, as NovAtel and Unicore use it: initial value 0, no inversion at the end
)

_STRIDE: Final = 8  # bytes that the CRC takes at once


def _crc24q_tables() -> NDArray[np.int64]:
    """Return the CRC of a byte that ``k`` zero bytes follow, by k and byte."""
    tables = np.zeros((_STRIDE, 256), np.int64)
    for byte in range(256):
        crc = byte << 16
        for k in range(_STRIDE):
            for _ in range(8):
                crc <<= 1
                if crc & 0x1000000:
                    crc ^= CRC24Q_POLYNOMIAL
            tables[k, byte] = crc
    return tables


CRC24Q = _crc24q_tables()


def _crc32_tables() -> NDArray[np.int64]:
    """Return the CRC-32 of a byte that ``k`` zero bytes follow, by k and byte."""
    tables = np.zeros((_STRIDE, 256), np.int64)
    for byte in range(256):
        crc = byte
        for k in range(_STRIDE):
            for _ in range(8):
                crc = crc >> 1 ^ (CRC32_POLYNOMIAL if crc & 1 else 0)
            tables[k, byte] = crc
    return tables


CRC32 = _crc32_tables()


@kernel
def crc24q_range(data: Bytes, start: int, end: int) -> int:
    """Return the CRC-24Q of ``data[start:end]`` (initial value 0)."""
    part, crc, whole = data[start:end], 0, (end - start) // _STRIDE * _STRIDE
    for i in range(0, whole, _STRIDE):
        crc ^= int(part[i]) << 16 | int(part[i + 1]) << 8 | int(part[i + 2])
        following = 0
        for k in range(3, _STRIDE):
            following ^= int(CRC24Q[_STRIDE - 1 - k, part[i + k]])
        crc = int(CRC24Q[7, crc >> 16]) ^ int(CRC24Q[6, crc >> 8 & 255]) ^ int(CRC24Q[5, crc & 255]) ^ following
    for i in range(whole, len(part)):
        crc = ((crc << 8) & 0xFFFFFF) ^ int(CRC24Q[0, (crc >> 16) ^ int(part[i])])
    return crc


def crc24q(data: Bytes) -> int:
    """Return the CRC-24Q of all bytes."""
    return int(crc24q_range(data, 0, len(data)))


@kernel
def crc32_range(data: Bytes, start: int, end: int) -> int:
    """Return the CRC-32 of NovAtel and Unicore of ``data[start:end]`` (NovAtel OEM7 reference 1.7, Unicore N4 R1.13 7.1)."""
    part, crc, whole = data[start:end], 0, (end - start) // _STRIDE * _STRIDE
    for i in range(0, whole, _STRIDE):
        crc ^= int(part[i]) | int(part[i + 1]) << 8 | int(part[i + 2]) << 16 | int(part[i + 3]) << 24
        following = 0
        for k in range(4, _STRIDE):
            following ^= int(CRC32[_STRIDE - 1 - k, part[i + k]])
        crc = (
            int(CRC32[7, crc & 255]) ^ int(CRC32[6, crc >> 8 & 255]) ^ int(CRC32[5, crc >> 16 & 255]) ^ int(CRC32[4, crc >> 24]) ^ following
        )
    for i in range(whole, len(part)):
        crc = crc >> 8 ^ int(CRC32[0, (crc ^ int(part[i])) & 255])
    return crc


def crc32(data: Bytes) -> int:
    """Return the CRC-32 of all bytes, as NovAtel and Unicore count it."""
    return int(crc32_range(data, 0, len(data)))


@kernel
def fletcher16_range(data: Bytes, start: int, end: int) -> int:
    """Return the UBX checksum (CK_A + 256 CK_B) of ``data[start:end]``: 8-bit Fletcher, u-blox interface description 3.4."""
    # The second sum counts each byte as often as it lies in the first one. Sums of up to 8200 bytes of 255 need 35 bits at most, so the
    # reduction modulo 256 can wait until the end.
    part, a, b = data[start:end], 0, 0
    for i in range(len(part)):
        value = int(part[i])
        a += value
        b += (len(part) - i) * value
    return (a & 0xFF) | (b & 0xFF) << 8


def fletcher16(data: Bytes) -> int:
    """Return the UBX checksum (CK_A + 256 CK_B) of all bytes (class to end of payload)."""
    return int(fletcher16_range(data, 0, len(data)))


def _crc16_table() -> NDArray[np.int64]:
    """Return the CRC-16 of a byte."""
    table = np.zeros(256, np.int64)
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = (crc << 1) & 0xFFFF ^ (CRC16_POLYNOMIAL if crc & 0x8000 else 0)
        table[byte] = crc
    return table


CRC16 = _crc16_table()


@kernel
def crc16_range(data: Bytes, start: int, end: int) -> int:
    """Return the CRC-16 (CCITT, initial value 0) of ``data[start:end]``."""
    part, crc = data[start:end], 0
    for i in range(len(part)):
        crc = ((crc << 8) & 0xFFFF) ^ int(CRC16[(crc >> 8) ^ int(part[i])])
    return crc


def crc16(data: Bytes) -> int:
    """Return the CRC-16 (CCITT, initial value 0) of all bytes."""
    return int(crc16_range(data, 0, len(data)))
