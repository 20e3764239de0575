"""Files that a command writes: a file is there whole or not at all, and none is replaced that was not to be."""

from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import IO, Self

from rtkmesh_services.errors import SourceError


def check_free(paths: list[Path], inputs: list[Path], *, force: bool) -> None:
    """SourceError where a file that is to be written is there (unless ``force``), or is one of those that are read."""
    read = {path.resolve() for path in inputs}
    for path in paths:
        if path.resolve() in read:
            raise SourceError(f"{path} is what is to be converted: say another --out")
        if path.exists() and not force:
            raise SourceError(f"{path} exists: say --force to replace it, or another --out")


class WrittenFile:
    """A file that gets its name when everything is in it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._part = path.with_name(path.name + ".part")
        self.size = 0
        try:
            self._file: IO[bytes] = self._part.open("wb")
        except OSError as error:
            raise SourceError(f"{path}: {error.strerror}") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if kind is not None:
            self.drop()
            return
        try:
            self._file.close()
            self._part.replace(self.path)
        except OSError as problem:
            self.drop()
            raise SourceError(f"{self.path}: {problem.strerror}") from problem

    def write(self, data: bytes) -> None:
        """Append bytes; SourceError where the disk takes no more."""
        try:
            self._file.write(data)
        except OSError as error:
            raise SourceError(f"{self.path}: {error.strerror}") from error
        self.size += len(data)

    def drop(self) -> None:
        """Leave no file."""
        with suppress(OSError):  # what could not be written cannot be written now
            self._file.close()
        self._part.unlink(missing_ok=True)
