"""A deployment file on trial: the whole of ``rtkmesh check`` before anything that runs is touched.

Sources and targets are looked at by the roles that open them, which control does not load: the check is a process of its own.
"""

import subprocess
import sys
from pathlib import Path
from typing import Final

PATIENCE_S: Final = 30.0
_WRONG: Final = 2


def examine(file: Path, data_folder: Path | None, patience_s: float = PATIENCE_S) -> str:
    """Return the faults of a deployment file, a line each; empty when it is right."""
    command = [sys.executable, "-m", "rtkmesh_services.cli.main", "check", str(file)]
    command += ["--data", str(data_folder)] if data_folder is not None else []
    try:
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=patience_s, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"{file} could not be checked: {error}"
    if done.returncode == 0:
        return ""
    faults = done.stderr.strip()
    return faults if done.returncode == _WRONG and faults else f"{file} could not be checked: exit code {done.returncode}: {faults[-500:]}"
