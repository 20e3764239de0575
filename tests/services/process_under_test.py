"""A process for the tests of the runtime: ``python process_under_test.py CONFIG ID [FILE]``. Its operations are ways to misbehave.

The config's hub says where to connect. With a FILE it warms until there is such a file.
It runs through the same ``run_service`` as every role.
"""

import sys
import threading
import time
from pathlib import Path
from typing import Any, ClassVar

from rtkmesh_schemas.command import Reply, Request
from rtkmesh_schemas.keys import SOL_TEXT, Role
from rtkmesh_services.errors import ServiceError
from rtkmesh_services.runtime.bus import Bus, Sample, endpoints_for
from rtkmesh_services.runtime.configuration import load_site
from rtkmesh_services.runtime.process import leave, run_service
from rtkmesh_services.runtime.service import Context, Report, Service, accepted, done
from rtkmesh_services.runtime.zenoh_bus import open_bus

LONG_S = 0.02  # of a publish that waits for others


class Misbehaving(Service):
    """Does what it is told, however bad."""

    role: ClassVar[Role] = Role.SOLVER
    operations: ClassVar[dict[str, str]] = {
        "crash": "raise in the loop",
        "crash_thread": "raise in a thread",
        "site": "raise a fault of the site",
        "hang": "hang the loop",
        "hang_close": "hang when asked to close",
        "burn": "hang in a thread that does not yield at the end",
        "publish": "count=N: publish N numbered texts",
    }

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._next = ""
        self._hang_close = False
        self._received = 0
        self._slow_s = 0.0
        self._long_publishes = 0

    def warm(self) -> None:
        while len(sys.argv) > 3 and not Path(sys.argv[3]).exists() and not self.context.stopping.is_set():
            self.context.wait(0.01)

    def open(self) -> None:
        self.context.subscribe("rtk/*/obs", lane="obs")
        self.context.subscribe("rtk/*/status", lane="status", latest=True, history=True)
        self.context.bus.subscribe("rtk/*/sol/flood", self._count)

    def _count(self, sample: Sample) -> None:
        self._received += len(sample.payload) > 0

    def handle(self, item: Any) -> None:
        pass

    def tick(self, now_mono_ns: int) -> None:
        assert now_mono_ns > 0
        todo, self._next = self._next, ""
        if todo == "crash":
            raise RuntimeError("told to crash")
        if todo == "site":
            raise ServiceError("the device is not there")
        if todo == "crash_thread":
            threading.Thread(target=self._crash).start()
        if todo == "hang":
            time.sleep(60.0)

    def _crash(self) -> None:
        raise RuntimeError("told to crash in a thread")

    def command(self, request: Request) -> Reply:
        if request.op == "publish":
            for number in range(int(request.args["count"])):
                began = time.monotonic()
                self.context.bus.publish(SOL_TEXT, "x" * 1000 + str(number), format="flood")
                self._long_publishes += time.monotonic() - began > LONG_S
            return done("published")
        if request.op == "hang_close":
            self._hang_close = True
        elif request.op == "burn":
            threading.Thread(target=time.sleep, args=(60.0,)).start()
        else:
            self._next = request.op
        return accepted(request.op)

    def report(self) -> Report:
        return Report(counters={"received": self._received}, data={"long_publishes": self._long_publishes})

    def close(self) -> None:
        if self._hang_close:
            time.sleep(60.0)


def main() -> None:
    """Run the process."""
    site = load_site(Path(sys.argv[1]))

    def connect() -> Bus:
        return open_bus(sys.argv[2], endpoints_for((), site.deployment.hub.listen), namespace=site.deployment.deployment.namespace)

    leave(run_service(Misbehaving, role=Role.SOLVER, id=sys.argv[2], site=site, open_bus=connect))


if __name__ == "__main__":
    main()
