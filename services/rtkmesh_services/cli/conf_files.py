"""Files that ``rtkmesh conf`` writes: none is replaced, secrets are their owner's alone."""

import os
from pathlib import Path

from rtkmesh_services.errors import SourceError

_PRIVATE = 0o600


def write_new(path: Path, text: str, mode: int = 0o666) -> None:
    """Write a file that is not there yet; SourceError where it is, or cannot be."""
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
        with open(descriptor, "w", encoding="utf-8") as file:  # noqa: PTH123  a descriptor
            file.write(text)
    except FileExistsError:
        raise SourceError(f"{path} exists and is not replaced: say another --out, or take it away") from None
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror}") from error


def write_secrets(path: Path, secrets: dict[str, str]) -> None:
    """Write the variables of the environment as systemd's EnvironmentFile has them, readable by the owner alone."""
    quoted = {name: value.replace("\\", "\\\\").replace('"', '\\"') for name, value in secrets.items()}
    write_new(path, "".join(f'{name}="{value}"\n' for name, value in quoted.items()), _PRIVATE)
