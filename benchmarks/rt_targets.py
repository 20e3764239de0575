"""The programs that ``rt_load`` feeds: started, asked where their solutions come out, and stopped again. Runs with numpy alone.

All targets have the same members: ``count`` instances, when each was ``started`` and all were ``ready`` (``time.monotonic``, s); ``start``,
``stop``, ``pids``, ``alive`` (exit codes, None while it runs) and ``solutions`` (where they come out, as ``rt_load`` says it).
"""

import contextlib
import os
import shlex
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

_CONSOLE: Final = ("help", "status", "satellite", "stream")
_TRIES: Final = 400  # of rtkrcv's console, 10 ms apart
_STOPPED_S: Final = 3.0  # time for a program to stop by itself


def free_ports(count: int) -> list[int]:
    """Return so many TCP ports that nobody listens on now."""
    sockets = [socket.create_server(("127.0.0.1", 0)) for _ in range(count)]
    ports = [one.getsockname()[1] for one in sockets]
    for one in sockets:
        one.close()
    return ports


class Processes:
    """Processes that this driver has started."""

    def __init__(self, count: int) -> None:
        self.count, self.procs, self.started, self.ready = count, list[subprocess.Popen[bytes]](), list[float](), 0.0

    def pids(self) -> list[int]:
        """Return their numbers."""
        return [p.pid for p in self.procs]

    def alive(self) -> list[int | None]:
        """Return their exit codes."""
        return [p.poll() for p in self.procs]


class Rtkrcv(Processes):
    """Processes of RTKLIB's rtkrcv, fed by our two ports; each has a telnet console (2.4.x has to be started through it).

    ``conf``: processing options to start from, ``formats`` of rover and base, ``overrides``: KEY=VALUE over both.
    """

    def __init__(
        self, binary: str, count: int, conf: str | None, formats: Sequence[str], rover: str, base: str, overrides: Sequence[str] = (),
        headless: bool | None = None, nice: int = 0,
    ) -> None:  # fmt: skip
        super().__init__(count)
        ports = free_ports(2 * count)
        self.binary, self.nice, self.out, self.console = binary, nice, ports[:count], ports[count:]
        self.headless = _has_no_console(binary) if headless is None else headless
        self.consoles: list[socket.socket | None] = [None] * count
        self.dir = tempfile.mkdtemp(prefix="rt_load_")
        keys = _streams(formats, rover, base) | dict(_split(one) for one in overrides)
        kept = [line for line in Path(conf).read_text().splitlines() if _split(line)[0] not in keys] if conf else []
        for i in range(count):
            own = keys | {"outstr1-path": f":{self.out[i]}"}
            self._folder(i).mkdir()
            (self._folder(i) / "c.conf").write_text("\n".join([*kept, *(f"{k:<18} ={v}" for k, v in own.items())]) + "\n")

    def _folder(self, i: int) -> Path:
        return Path(self.dir) / str(i)

    def start(self) -> None:
        """Start all, and what they do by their consoles where that is needed."""
        command = [self.binary, *(["-nc"] if self.headless else [])]
        lower: Callable[[], Any] | None = (lambda: os.nice(self.nice)) if self.nice else None
        for i in range(self.count):
            self.started.append(time.monotonic())
            with (self._folder(i) / "log").open("wb") as log:
                self.procs.append(subprocess.Popen(
                    [*command, "-p", str(self.console[i]), "-o", "c.conf"], cwd=self._folder(i), stdin=subprocess.DEVNULL, stdout=log,
                    stderr=subprocess.STDOUT, preexec_fn=lower,  # noqa: PLW1509  this driver has threads later on only
                ))  # fmt: skip
        if not self.headless:
            for i in range(self.count):
                self._console(i).sendall(b"start\r\n")
        self.ready = time.monotonic()

    def _console(self, i: int) -> socket.socket:
        """Return the open console of one instance."""
        if (known := self.consoles[i]) is not None:
            return known
        self.consoles[i] = opened = _connected(self.console[i])
        opened.settimeout(2)
        _until(opened, b"password:")
        opened.sendall(b"admin\r\n")
        _until(opened, b"rtkrcv>")
        return opened

    def console_rtt(self, i: int = 0, commands: Sequence[str] = _CONSOLE, repeat: int = 10) -> dict[str, dict[str, float]]:
        """Return the milliseconds from sending each command to the next prompt, and the bytes of the answer."""
        console, told = self._console(i), dict[str, dict[str, float]]()
        console.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        for command in commands:
            times_ms, size = list[float](), 0
            for _ in range(repeat):
                _forget_answers(console)
                asked = time.monotonic()
                console.sendall(command.encode() + b"\r\n")
                size = len(_until(console, b"rtkrcv> "))
                times_ms.append((time.monotonic() - asked) * 1e3)
                time.sleep(0.05)
            told[command] = {"p50_ms": round(float(np.median(times_ms)), 2), "max_ms": round(max(times_ms), 2), "bytes": size}
        return told

    def solutions(self) -> list[str]:
        """Return where solutions come out."""
        return [f"connect:127.0.0.1:{port}" for port in self.out]

    def stop(self) -> None:
        """Interrupt all; kill what is still there after three seconds."""
        for p in self.procs:
            if p.poll() is None:
                p.send_signal(signal.SIGINT)
        end = time.monotonic() + _STOPPED_S
        for p in self.procs:
            try:
                p.wait(max(0.05, end - time.monotonic()))
            except subprocess.TimeoutExpired:
                p.kill()
                p.wait()
        for console in self.consoles:
            if console is not None:
                console.close()


def _split(line: str) -> tuple[str, str]:
    """Return key and value of a line of options."""
    key, _, value = line.partition("=")
    return key.strip(), value


def _streams(formats: Sequence[str], rover: str, base: str) -> dict[str, str]:
    """Return the options that say where rtkrcv's data come from and go to."""
    return {
        "inpstr1-type": "tcpcli", "inpstr1-path": f"127.0.0.1:{rover}", "inpstr1-format": formats[0],
        "inpstr2-type": "tcpcli", "inpstr2-path": f"127.0.0.1:{base}", "inpstr2-format": formats[1],
        "inpstr3-type": "off", "outstr1-type": "tcpsvr", "outstr1-format": "xyz", "outstr2-type": "off",
        "logstr1-type": "off", "logstr2-type": "off", "logstr3-type": "off", "out-timeform": "tow",
        "out-timesys": "gpst", "out-solformat": "xyz", "out-outsingle": "off", "console-passwd": "admin",
    }  # fmt: skip


def _has_no_console(binary: str) -> bool:
    """Return whether this build starts by itself (demo5's -nc)."""
    told = subprocess.run([binary, "-h"], capture_output=True, text=True, timeout=5, stdin=subprocess.DEVNULL, check=False)
    return "-nc" in told.stdout + told.stderr


def _connected(port: int) -> socket.socket:
    """Return a connection to a port of this machine on which somebody listens soon."""
    for _ in range(_TRIES - 1):
        with contextlib.suppress(OSError):
            return socket.create_connection(("127.0.0.1", port), 1)
        time.sleep(0.01)
    return socket.create_connection(("127.0.0.1", port), 1)


def _until(console: socket.socket, mark: bytes) -> bytes:
    """Return what a console says up to a mark, or until it says no more."""
    got = b""
    with contextlib.suppress(OSError):
        while mark not in got and (more := console.recv(65536)):
            got += more
    return got


def _forget_answers(console: socket.socket) -> None:
    """Read what nobody waited for, such as the answer to "start"."""
    console.setblocking(False)
    with contextlib.suppress(BlockingIOError):
        while console.recv(65536):
            pass
    console.settimeout(2)


class Spawn(Processes):
    """Processes of any command line; {i} instance, {rover} {base} our feed ports, {out} a free port for its solutions."""

    def __init__(self, command: str, count: int, rover: str, base: str, solution: str = "connect") -> None:
        super().__init__(count)
        self.command, self.feeds, self.out, self.solution = command, (rover, base), free_ports(count), solution

    def start(self) -> None:
        """Start all, each in a group of its own."""
        for i in range(self.count):
            line = self.command.format(i=i, rover=self.feeds[0], base=self.feeds[1], out=self.out[i])
            self.started.append(time.monotonic())
            self.procs.append(subprocess.Popen(shlex.split(line), stdin=subprocess.DEVNULL, start_new_session=True))
        self.ready = time.monotonic()

    def solutions(self) -> list[str]:
        """Return where solutions come out."""
        return [f"{self.solution}:127.0.0.1:{port}" for port in self.out]

    def stop(self) -> None:
        """Interrupt the groups; terminate and at last kill what is still there."""
        for sign, wait_s in ((signal.SIGINT, _STOPPED_S), (signal.SIGTERM, _STOPPED_S), (signal.SIGKILL, 1.0)):
            for p in self.procs:
                if p.poll() is None:
                    os.killpg(p.pid, sign)
            end = time.monotonic() + wait_s
            while time.monotonic() < end and any(p.poll() is None for p in self.procs):
                time.sleep(0.02)


class External:
    """A server that somebody else runs: its processes, and where its solutions come out."""

    def __init__(self, pids: Sequence[int], solutions: Sequence[str]) -> None:
        self._pids, self._solutions, self.count, self.started, self.ready = pids, solutions, len(solutions), list[float](), 0.0

    def start(self) -> None:
        """Note the moment; it runs."""
        self.ready = time.monotonic()
        self.started = [self.ready] * self.count

    def pids(self) -> Sequence[int]:
        """Return the numbers of its processes."""
        return self._pids

    def solutions(self) -> Sequence[str]:
        """Return where solutions come out."""
        return self._solutions

    def alive(self) -> list[str | None]:
        """Return which processes are gone."""
        return [None if Path(f"/proc/{p}").exists() else "gone" for p in self._pids]

    def stop(self) -> None:
        """Leave it alone."""
