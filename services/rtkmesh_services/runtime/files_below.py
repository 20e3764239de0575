"""Files that are named from outside: only plain names below one folder, no way out, no link, no device."""

import os
import re
import stat
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

from rtkmesh_schemas.errors import ConfigError
from rtkmesh_services.runtime.words import clip

_FILE_NAME: Final = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,99}")
_DEEPEST: Final = 16  # folders


def read_below(name: str, folder: Path, limit: int) -> bytes:
    """Return what is in a file below ``folder``, opened step by step without following links; ConfigError for anything else.

    ``name`` is a file's name or a relative path of plain names: a regular file of at most ``limit`` bytes.
    """
    with _opened(name, folder) as (parent, last):
        descriptor = os.open(last, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK, dir_fd=parent)
        try:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                raise ConfigError(name, None, "no regular file")
            data = os.read(descriptor, limit + 1)
        finally:
            os.close(descriptor)
    if len(data) > limit:
        raise ConfigError(name, None, f"more than {limit} bytes")
    return data


def write_below(name: str, folder: Path, data: bytes, *, overwrite: bool = False) -> None:
    """Put a file below ``folder``, whole or not at all and durable; ConfigError if it cannot be, or is there without ``overwrite``."""
    with _opened(name, folder) as (parent, last):
        beside = f".{last}.new-{os.getpid()}"
        try:
            _write(beside, parent, data)
            if overwrite:
                _refuse_other_kinds(name, last, parent)
                os.rename(beside, last, src_dir_fd=parent, dst_dir_fd=parent)
            else:
                os.link(beside, last, src_dir_fd=parent, dst_dir_fd=parent)
            os.fsync(parent)
        except FileExistsError as error:
            raise ConfigError(name, None, "is there already; overwrite=true replaces it") from error
        finally:
            with suppress(OSError):
                os.unlink(beside, dir_fd=parent)


def _write(name: str, parent: int, data: bytes) -> None:
    descriptor = os.open(name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW, 0o644, dir_fd=parent)
    with os.fdopen(descriptor, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(descriptor)


def _refuse_other_kinds(name: str, last: str, parent: int) -> None:
    with suppress(FileNotFoundError):
        if not stat.S_ISREG(os.stat(last, dir_fd=parent, follow_symlinks=False).st_mode):
            raise ConfigError(name, None, "no regular file")


@contextmanager
def _opened(name: str, folder: Path) -> Generator[tuple[int, str]]:
    """Open the folder that a file is in; yield it with the file's name. OSError becomes ConfigError."""
    parts = name.split("/")
    if len(parts) > _DEEPEST or any(not _FILE_NAME.fullmatch(part) for part in parts):
        raise ConfigError(clip(name), None, "no file's name: letters, digits, '.', '_', '-', below the configuration folder")
    descriptors: list[int] = []
    try:
        descriptors.append(os.open(folder, os.O_RDONLY | os.O_DIRECTORY))
        for part in parts[:-1]:
            descriptors.append(os.open(part, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW, dir_fd=descriptors[-1]))
        yield descriptors[-1], parts[-1]
    except OSError as error:
        raise ConfigError(name, None, f"{error.strerror or error} (below the configuration folder)") from error
    finally:
        for descriptor in descriptors:
            os.close(descriptor)
