"""A process that has loaded what engine processes have in common and becomes one of them by forking, as its parent asks.

It has one thread and no session, so that a fork is complete. A forked process is handed over to control, the nearest ancestor that
adopts orphans: its middle parent ends at once.
"""

import ctypes
import gc
import importlib
import json
import os
import socket
import sys
import time
from pathlib import Path
from typing import Any, Final, NoReturn

from rtkmesh_schemas.keys import Role
from rtkmesh_services.cli import main as command_line
from rtkmesh_services.control.forking import REQUEST_BYTES
from rtkmesh_services.runtime.kernel_cache import use_kernel_cache
from rtkmesh_services.runtime.process import PARENT_VARIABLE, follow_parent, leave

ADOPTION_S: Final = 5.0
_PR_SET_NAME: Final = 15
_FIRST_FIELD, _ARG_START, _ARG_END = 3, 48, 49  # of /proc/PID/stat behind the name, proc(5)


def serve(channel: socket.socket, roles: list[Role]) -> None:
    """Load what each role needs, say so, and fork whenever the parent asks, until it is gone."""
    gc.disable()
    command_line.application("run")
    for name in ("process", "zenoh_bus", "configuration"):
        importlib.import_module(f"rtkmesh_services.runtime.{name}")
    send(channel, ready=[role.value for role in roles if load(channel, role)])
    while True:
        data, descriptors, _, _ = socket.recv_fds(channel, REQUEST_BYTES, 2)
        if not data:
            return
        pid = fork(channel, json.loads(data), descriptors)
        for descriptor in descriptors:
            os.close(descriptor)
        send(channel, pid=pid)


def load(channel: socket.socket, role: Role) -> bool:
    """Load what all processes of a role have in common; False and a word to the parent if that fails."""
    try:
        module = importlib.import_module(f"rtkmesh_services.{role.value}.service")
        getattr(module, "preload", gc.collect)()
    except Exception as error:  # noqa: BLE001  processes of this role are then started as programs, which meet it themselves
        send(channel, error=f"{role.value}: {type(error).__name__}: {error}")
        return False
    gc.collect()
    gc.freeze()
    return True


def fork(channel: socket.socket, request: dict[str, Any], descriptors: list[int]) -> int:
    """Fork a process that our parent will have adopted when this returns; return its pid."""
    read, write = os.pipe()
    middle = os.fork()
    if middle == 0:
        pid = os.fork()
        if pid == 0:
            channel.close()
            os.close(read)
            os.close(write)
            become(request["argv"], request["environment"], *descriptors)
        os.write(write, str(pid).encode())
        os._exit(0)
    os.close(write)
    pid = int(os.read(read, 32))
    os.close(read)
    os.waitpid(middle, 0)
    return pid


def become(argv: list[str], environment: dict[str, str], out: int, err: int) -> NoReturn:
    """Run a command line in this process, as if it had been started as a program."""
    parent = os.environ[PARENT_VARIABLE]
    kernels = {"NUMBA_CACHE_DIR": os.environ["NUMBA_CACHE_DIR"]}
    os.setsid()
    null = os.open(os.devnull, os.O_RDONLY)
    for target, descriptor in enumerate((null, out, err)):
        os.dup2(descriptor, target)
        os.close(descriptor)
    os.environ.clear()
    os.environ.update(environment | kernels)
    deadline_s = time.monotonic() + ADOPTION_S
    while os.getppid() != int(parent) and time.monotonic() < deadline_s:
        time.sleep(0.001)  # the middle parent is ending
    set_title(f"rtkmesh {' '.join(argv)}", argv[argv.index("--id") + 1] if "--id" in argv else argv[0])
    sys.argv = ["rtkmesh", *argv]
    gc.enable()
    leave(command_line.run(argv))


def set_title(title: str, name: str) -> None:
    """Show ``title`` as this process's command line and ``name`` as its short name in `ps`: it has those of the server."""
    fields = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
    start, end = int(fields[_ARG_START - _FIRST_FIELD]), int(fields[_ARG_END - _FIRST_FIELD])
    data = title.encode()[: end - start - 1]
    ctypes.memmove(start, data.ljust(end - start, b"\0"), end - start)
    ctypes.CDLL(None).prctl(_PR_SET_NAME, name.encode()[:15], 0, 0, 0)


def send(channel: socket.socket, **message: Any) -> None:
    """Tell the parent; a parent that is gone needs nothing."""
    try:
        channel.send(json.dumps(message).encode())
    except OSError:
        sys.exit(0)


def main() -> None:
    """Serve on the descriptor that the first argument names, for the roles that follow; the rest is room for a title."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    follow_parent()
    use_kernel_cache()
    channel = socket.socket(fileno=int(sys.argv[1]))
    channel.set_inheritable(False)
    roles = [Role(name) for name in sys.argv[2:] if not name.startswith(".")]
    set_title("rtkmesh fork server", "rtkmesh-fork")
    serve(channel, roles)


if __name__ == "__main__":
    main()
