"""What this host keeps from one start to the next: JSON files in one folder, written whole or not at all."""

import fcntl
import os
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import msgspec

STATE_VARIABLE: Final = "RTKMESH_STATE"


def state_folder() -> Path:
    """Return where this host keeps what it learns: RTKMESH_STATE, else rtkmesh in XDG_STATE_HOME or ~/.local/state."""
    if found := os.environ.get(STATE_VARIABLE):
        return Path(found)
    home = os.environ.get("XDG_STATE_HOME")
    return (Path(home) if home else Path.home() / ".local" / "state") / "rtkmesh"


@contextmanager
def locked(file: Path) -> Generator[None]:
    """Keep other processes from changing a file of the folder meanwhile; the folder is made. OSError if that fails."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def write_state(file: Path, encoded: bytes, *, durable: bool = True) -> None:
    """Put JSON in the file's place, indented for people, durable before it counts; OSError if that fails.

    Not ``durable``: it need not outlive a power cut, as what is known of running processes.
    """
    beside = file.with_suffix(".new")
    with beside.open("wb") as new:
        new.write(msgspec.json.format(encoded, indent=2) + b"\n")
        new.flush()
        if durable:
            os.fsync(new.fileno())
    beside.replace(file)
