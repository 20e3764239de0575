"""What the keeper remembers of its fleet from one control to the next."""

import logging
from collections.abc import Iterable

import msgspec

from rtkmesh_services.control.registry import DeploymentFolder, Desired, ProcessEntry, Running

_log = logging.getLogger("rtkmesh.control")


class Memory:
    """The state on disk, if there is a folder for it. A disk that fails costs the memory, never the fleet."""

    def __init__(self, folder: DeploymentFolder | None = None, running: Running | None = None, *, fresh: bool = False) -> None:
        """``running``: who we are; ``fresh``: what commands have made of the file is forgotten."""
        self._folder, self._running = folder, running or Running()
        self.left = Running() if folder is None else folder.running()
        self.desired = Desired() if folder is None or fresh else folder.desired()
        self.errors = 0
        self._written = Desired() if fresh else self.desired

    @property
    def is_new(self) -> bool:
        """Whether something is wanted that is not written yet."""
        return self.desired is not self._written

    def write(self, entries: Iterable[ProcessEntry]) -> None:
        """Keep what is wanted and what runs."""
        self._running = msgspec.structs.replace(self._running, processes={entry.id: entry for entry in entries})
        self._save()

    def end(self) -> None:
        """Nothing runs any more, and control goes."""
        self._running = msgspec.structs.replace(self._running, processes={}, control=None)
        self._save()

    def _save(self) -> None:
        self._written = self.desired
        if self._folder is None:
            return
        try:
            self._folder.write_desired(self.desired)
            self._folder.write_running(self._running)
        except OSError as error:
            self.errors += 1
            if self.errors == 1:
                _log.warning("the state of the fleet cannot be kept: %s", error)
