"""Who a process is, as Linux tells it: real processes."""

import mmap
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from rtkmesh_services.runtime.host_processes import (
    Identity,
    group_members,
    identity_of,
    is_alive,
    memory_bytes,
    send_signal,
    uptime_s,
    writers_below,
)

WAITS = "import sys; print('up', flush=True); sys.stdin.read()"


@pytest.fixture
def process() -> Iterator[subprocess.Popen[bytes]]:
    """A process in a session of its own that waits for its input's end."""
    with subprocess.Popen(
        [sys.executable, "-S", "-E", "-c", WAITS], stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True
    ) as made:
        assert made.stdout is not None
        assert made.stdout.readline() == b"up\n"
        yield made
        made.kill()


def found(pid: int) -> Identity:
    identity = identity_of(pid)
    assert identity is not None
    return identity


def test_a_process_is_itself_until_it_ends(process: subprocess.Popen[bytes]) -> None:
    """A zombie is not alive: nobody has to have waited for it."""
    identity = found(process.pid)
    assert is_alive(identity)
    process.kill()
    os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
    assert not is_alive(identity)
    assert identity_of(process.pid) is None


@pytest.mark.parametrize("other", [{"start_ticks": 1}, {"world": "another boot pid:[1]"}, {"pid": 0}])
def test_a_pid_of_another_start_or_boot_is_another_process(other: dict[str, object]) -> None:
    mine = found(os.getpid())
    assert is_alive(mine)
    assert not is_alive(replace(mine, **other))  # type: ignore[arg-type]  of its fields


def test_a_signal_goes_to_that_very_process_only(process: subprocess.Popen[bytes]) -> None:
    identity = found(process.pid)
    assert not send_signal(replace(identity, start_ticks=identity.start_ticks - 1), signal.SIGKILL)
    assert process.poll() is None
    assert send_signal(identity, signal.SIGKILL)
    assert process.wait(60.0) == -signal.SIGKILL
    assert not send_signal(identity, signal.SIGKILL)


def test_uptime_is_that_of_the_process(process: subprocess.Popen[bytes]) -> None:
    """It agrees with what ps says, which counts whole seconds."""
    theirs = int(subprocess.run(["ps", "-o", "etimes=", "-p", str(os.getpid())], capture_output=True, check=True).stdout)
    assert theirs - 1.1 <= uptime_s(found(os.getpid())) <= theirs + 2.1
    assert uptime_s(found(process.pid)) < uptime_s(found(os.getpid()))


def test_memory_grows_with_what_is_used() -> None:
    """Pages of our own: the process may have freed memory to give."""
    before = memory_bytes(os.getpid())
    with mmap.mmap(-1, 30_000_000) as pages:
        for offset in range(0, len(pages), mmap.PAGESIZE):
            pages[offset] = 1
        after = memory_bytes(os.getpid())
    assert before is not None
    assert after is not None
    assert 25e6 < after - before < 40e6
    assert memory_bytes(0) is None


def test_members_of_a_group(process: subprocess.Popen[bytes]) -> None:
    assert group_members(process.pid) == [process.pid]


def test_who_writes_below_a_folder_is_found(tmp_path: Path) -> None:
    """By its error output, whatever it is called."""
    with (tmp_path / "one.log").open("wb") as log:
        made = subprocess.Popen([sys.executable, "-S", "-E", "-c", WAITS], stdin=subprocess.PIPE, stdout=log, stderr=log)
    with made:
        identity = found(made.pid)
        deadline = time.monotonic() + 60.0
        while writers_below(tmp_path) != {identity: tmp_path / "one.log"}:  # its output is there before it is that program
            assert time.monotonic() < deadline
        assert writers_below(tmp_path / "deeper") == {}
        made.kill()
