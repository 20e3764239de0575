"""Random frames by the hundred thousand: what our own encoders make, mutated, and what nobody makes, under plausible headers.

A *body* is what a protocol's ``seal`` turns into a frame with right length and checksum: UBX class, id and payload; RTCM 3 payload;
NMEA text between ``$`` and ``*``.
"""

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel

BINARY: Final = np.arange(256, dtype=np.uint8)
_BATCH: Final = 4096

Bytes = NDArray[np.uint8]


@kernel
def _random_bytes(out: Bytes, start: int, end: int, alphabet: Bytes, zeros: int) -> None:
    """Fill with bytes of the alphabet; of ``zeros`` + 1 bytes one is random, the others are its first."""
    for i in range(start, end):
        out[i] = alphabet[np.random.randint(len(alphabet))] if zeros == 0 or np.random.randint(zeros + 1) == 0 else alphabet[0]


@kernel
def _mutate(out: Bytes, start: int, end: int, alphabet: Bytes) -> None:
    """Change a few bytes: another one of the alphabet, or one bit where the alphabet is all bytes."""
    changes = 1
    while np.random.randint(3) and changes < 12:
        changes += 1
    for _ in range(changes if end > start else 0):
        i = start + np.random.randint(end - start)
        if len(alphabet) == 256 and np.random.randint(2):
            out[i] ^= 1 << np.random.randint(8)
        else:
            out[i] = alphabet[np.random.randint(len(alphabet))]


@kernel
def _random_length(longest: int) -> int:
    """Return a length: mostly short, sometimes up to the longest."""
    choice = np.random.randint(8)
    if choice < 4:
        return np.random.randint(min(longest, 64) + 1)
    if choice < 7:
        return np.random.randint(min(longest, 320) + 1)
    return np.random.randint(longest + 1)


@kernel
def _fill(
    seed: int, count: int, pool: Bytes, pool_ends: NDArray[np.int64], heads: Bytes, alphabet: Bytes, longest: int, out: Bytes,
    ends: NDArray[np.int64],
) -> int:  # fmt: skip
    """Write bodies one behind the other: half of them mutated ones of the pool, the others random behind a known or any head."""
    np.random.seed(seed)
    position, width = 0, heads.shape[1]
    for n in range(count):
        start = position
        if np.random.randint(2):
            k = np.random.randint(len(pool_ends))
            first = pool_ends[k - 1] if k else 0
            position += pool_ends[k] - first
            out[start:position] = pool[first : pool_ends[k]]
            cut = np.random.randint(10)
            if cut == 0:
                position = start + width + np.random.randint(position - start - width + 1)
            elif cut == 1:
                more = min(start + longest, position + np.random.randint(64))
                _random_bytes(out, position, more, alphabet, 0)
                position = max(position, more)
            _mutate(out, start, position, alphabet)
        else:
            position += max(width, _random_length(longest))
            _random_bytes(out, start, position, alphabet, 3 * np.random.randint(3))
            if np.random.randint(8):
                out[start : start + width] = heads[np.random.randint(len(heads))]
        ends[n] = position
    return position


def bodies(seed: int, pool: Sequence[bytes], heads: Sequence[bytes], alphabet: Bytes, longest: int) -> Iterator[bytes]:
    """Yield random bodies for ever. ``heads``: first bytes of known messages, all of one length."""
    ends = np.cumsum([len(body) for body in pool])
    joined, known = np.frombuffer(b"".join(pool), np.uint8), np.frombuffer(b"".join(heads), np.uint8).reshape(len(heads), -1)
    room = max(longest, *(len(body) for body in pool)) + 64
    out, cuts = np.empty(_BATCH * room, np.uint8), np.empty(_BATCH, np.int64)
    while True:
        size = _fill(seed, _BATCH, joined, ends, known, alphabet, longest, out, cuts)
        data, start = out[:size].tobytes(), 0
        for end in cuts.tolist():
            yield data[start:end]
            start = end
        seed += 1
