"""Saved positions of base stations: one file of the host, written whole or not at all, nothing in it ever lost.

A position is replaced only when that is asked for; what it replaces, and what is forgotten, stays in the history.
"""

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import msgspec

from rtkmesh_schemas.base import BasePosition
from rtkmesh_schemas.command import Code
from rtkmesh_services.errors import CommandError, ServiceError
from rtkmesh_services.runtime.state_files import locked, state_folder, write_state

FILE_NAME: Final = "base_positions.json"
MAXIMUM_BYTES: Final = 1 << 22
HISTORY: Final = 50
MAXIMUM_PRESETS: Final = 1000


class Preset(msgspec.Struct, kw_only=True):
    """A name's position (None: forgotten) and those before it, newest first."""

    current: BasePosition | None = None
    history: list[BasePosition] = []


class PresetFile(msgspec.Struct, kw_only=True):
    """The file."""

    version: int = 1
    presets: dict[str, Preset] = {}


class PresetStore:
    """The saved positions in a folder; several processes may use it at once."""

    def __init__(self, folder: Path | None = None) -> None:
        self.file = (state_folder() if folder is None else folder) / FILE_NAME

    def all(self) -> dict[str, Preset]:
        """Return everything that is saved, also the forgotten; ServiceError for a file that cannot be read."""
        return self._read().presets

    def get(self, name: str) -> BasePosition | None:
        """Return the position saved under a name."""
        preset = self.all().get(name)
        return None if preset is None else preset.current

    def save(self, position: BasePosition, *, replace: bool = False) -> BasePosition | None:
        """Save a position under its name; return the one that it replaces. CommandError where there is one and ``replace`` is not said."""
        with self._changed() as file:
            preset = file.presets.get(position.name) or Preset()
            before = preset.current
            if before is not None and not replace:
                text = f"there is a position {position.name!r} of {before.saved_utc}; say replace to put this one in its place"
                raise CommandError(Code.WRONG_STATE, text)
            if position.name not in file.presets and len(file.presets) >= MAXIMUM_PRESETS:
                raise CommandError(Code.FAILED, f"there are {MAXIMUM_PRESETS} positions already")
            file.presets[position.name] = _with(preset, position)
        return before

    def forget(self, name: str) -> BasePosition:
        """Forget a position, but for the history; return it. CommandError where there is none."""
        with self._changed() as file:
            preset = file.presets.get(name)
            if preset is None or preset.current is None:
                raise CommandError(Code.BAD_ARGUMENTS, f"there is no position {name!r}")
            forgotten = preset.current
            file.presets[name] = _with(preset, None)
        return forgotten

    @contextmanager
    def _changed(self) -> Generator[PresetFile]:
        """Give the file's content, and write what became of it, while nobody else does."""
        try:
            with locked(self.file):
                content = self._read()
                yield content
                self._write(content)
        except OSError as error:
            raise ServiceError(f"{self.file}: {error.strerror or error}") from error

    def _read(self) -> PresetFile:
        try:
            if self.file.stat().st_size > MAXIMUM_BYTES:
                raise ServiceError(f"{self.file}: more than {MAXIMUM_BYTES} bytes")
            content = msgspec.json.decode(self.file.read_bytes(), type=PresetFile)
        except FileNotFoundError:
            return PresetFile()
        except OSError as error:
            raise ServiceError(f"{self.file}: {error.strerror or error}") from error
        except msgspec.MsgspecError as error:
            raise ServiceError(f"{self.file}: no file of base positions: {error}") from error
        if content.version != 1:
            raise ServiceError(f"{self.file}: version {content.version}, this program knows 1")
        return content

    def _write(self, content: PresetFile) -> None:
        write_state(self.file, msgspec.json.encode(content))


def _with(preset: Preset, position: BasePosition | None) -> Preset:
    before = [] if preset.current is None else [preset.current]
    return Preset(current=position, history=[*before, *preset.history][:HISTORY])
