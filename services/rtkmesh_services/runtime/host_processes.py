"""Processes of this host as Linux tells of them in /proc: who is it, is it still there, how much memory has it, what does it write to.

A pid alone says nothing: it is used again. A pid with its start time in one boot and one pid namespace names one process for ever.
"""

import os
import signal
import time
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final

PROC: Final = Path("/proc")
# Fields of /proc/PID/stat behind the name, proc(5): they begin with the third.
_FIRST, _GROUP, _SESSION, _START = 3, 5, 6, 22
_ENDED: Final = frozenset("ZXx")
_KIB: Final = 1024


@dataclass(frozen=True, slots=True)
class Identity:
    """One process for ever. ``start_ticks``: since boot; ``world``: the boot and the pid namespace in which they count."""

    pid: int
    start_ticks: int
    world: str


@cache
def world() -> str:
    """Return the name of this boot and pid namespace; empty where the kernel does not tell."""
    try:
        boot = (PROC / "sys/kernel/random/boot_id").read_text().strip()
        return f"{boot} {(PROC / 'self/ns/pid').readlink()}"
    except OSError:
        return ""


def identity_of(pid: int) -> Identity | None:
    """Return who has this pid now; None when nobody has, or only a zombie."""
    fields = _stat(pid)
    return Identity(pid, int(fields[_START - _FIRST]), world()) if fields and fields[0] not in _ENDED else None


def is_alive(identity: Identity) -> bool:
    """Whether that very process runs."""
    return identity.pid > 0 and identity_of(identity.pid) == identity


def uptime_s(identity: Identity) -> float:
    """Return how long a process of this boot has been there, seconds."""
    return max(0.0, time.clock_gettime(time.CLOCK_BOOTTIME) - identity.start_ticks / os.sysconf("SC_CLK_TCK"))


def memory_bytes(pid: int) -> int | None:
    """Return the proportional set size of a process (shared pages by their share), or its resident set; None when it is not told."""
    for name, label in (("smaps_rollup", "Pss:"), ("status", "VmRSS:")):
        with suppress(OSError, StopIteration, ValueError):
            lines = (PROC / str(pid) / name).read_text().splitlines()
            return _KIB * int(next(line for line in lines if line.startswith(label)).split()[1])
    return None


def group_members(group: int) -> list[int]:
    """Return the processes of a group and session of that number."""
    wanted = str(group)
    found = ((pid, _stat(pid)) for pid in _pids())
    return [pid for pid, fields in found if fields and fields[_GROUP - _FIRST] == fields[_SESSION - _FIRST] == wanted]


def writers_below(folder: Path) -> dict[Identity, Path]:
    """Return the processes whose error output is a file below a folder, and that file."""
    found: dict[Identity, Path] = {}
    for pid in _pids():
        with suppress(OSError):
            file = (PROC / str(pid) / "fd/2").readlink()
            if file.is_relative_to(folder) and (identity := identity_of(pid)) is not None:
                found[identity] = file
    return found


def send_signal(identity: Identity, number: int) -> bool:
    """Send a signal to that very process, never to one that has its pid later; False when it has gone."""
    try:
        descriptor = os.pidfd_open(identity.pid)
    except OSError:
        return _send_without_pidfd(identity, number)
    try:
        if not is_alive(identity):
            return False
        signal.pidfd_send_signal(descriptor, number)
    except ProcessLookupError:
        return False
    finally:
        os.close(descriptor)
    return True


def _send_without_pidfd(identity: Identity, number: int) -> bool:
    if not is_alive(identity):
        return False
    with suppress(ProcessLookupError):
        os.kill(identity.pid, number)
        return True
    return False


def _stat(pid: int) -> list[str]:
    """Return the fields of /proc/PID/stat from the third on: the name before them may hold anything."""
    try:
        return (PROC / str(pid) / "stat").read_text(errors="replace").rpartition(")")[2].split()
    except OSError:
        return []


def _pids() -> list[int]:
    try:
        return [int(name) for name in os.listdir(PROC) if name.isdigit()]  # noqa: PTH208  twice as fast as Path.iterdir
    except OSError:
        return []
