"""Values of a long run, kept in a temporary file and given back in either direction: a day of epochs needs no memory."""

import pickle
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from tempfile import TemporaryFile
from types import TracebackType
from typing import IO, Any, Final, Generic, Self, TypeVar

from rtkmesh_services.errors import SourceError

T = TypeVar("T")

_BLOCK: Final = 64  # values that are written and read at once
_FAST: Final = 1  # of zlib's levels: epochs shrink to a third


@dataclass(slots=True)
class Spool(Generic[T]):
    """Values that can be pickled; its file goes when it is closed. What values of one block share is still one object."""

    _file: IO[bytes] = field(default_factory=TemporaryFile)
    _blocks: list[tuple[int, int]] = field(default_factory=list[tuple[int, int]])  # place in the file and length (bytes)
    _newest: list[T] = field(default_factory=list[Any])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Give the file back."""
        self._file.close()

    def __len__(self) -> int:
        return len(self._blocks) * _BLOCK + len(self._newest)

    @property
    def size(self) -> int:
        """Bytes in the file."""
        return sum(self._blocks[-1]) if self._blocks else 0

    def append(self, value: T) -> None:
        """Take a value; SourceError where the disk takes no more."""
        self._newest.append(value)
        if len(self._newest) < _BLOCK:
            return
        block, place = zlib.compress(pickle.dumps(self._newest, pickle.HIGHEST_PROTOCOL), _FAST), self.size
        try:
            self._file.seek(place)
            self._file.write(block)
            self._file.flush()
        except OSError as error:
            raise SourceError(f"temporary file: {error.strerror}") from error
        self._blocks.append((place, len(block)))
        self._newest = []

    def forward(self) -> Iterator[T]:
        """Yield the values, the first one first."""
        for place, length in self._blocks:
            yield from self._block(place, length)
        yield from self._newest

    def backward(self) -> Iterator[T]:
        """Yield the values, the last one first."""
        yield from reversed(self._newest)
        for place, length in reversed(self._blocks):
            yield from reversed(self._block(place, length))

    def _block(self, place: int, length: int) -> list[T]:
        self._file.seek(place)
        block: list[T] = pickle.loads(zlib.decompress(self._file.read(length)))  # noqa: S301  what this object wrote itself
        return block
