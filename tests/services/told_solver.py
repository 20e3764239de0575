"""A solver that answers with RTKRCV's texts, as recorded from rtkrcv 2.4.3 b34: for tests of consoles."""

import threading
from typing import Any, ClassVar

from tests.patience import PATIENCE_S
from tests.services.old_script import SATELLITE_HEAD

from rtkmesh_schemas.command import Code, Reply, Request
from rtkmesh_schemas.config import Deployment, SolverTable
from rtkmesh_schemas.keys import Role
from rtkmesh_schemas.status import Level
from rtkmesh_services.errors import CommandError
from rtkmesh_services.runtime.lifecycle import Lifecycle
from rtkmesh_services.runtime.service import Context, Service

SITE = Deployment(solver={"rtk": SolverTable(rover="rover", mode="single")})


class Told(Service):
    """A solver that has RTKRCV's texts, as recorded."""

    role: ClassVar[Role] = Role.SOLVER
    tick_s: ClassVar[float] = 0.02
    operations: ClassVar[dict[str, str]] = dict.fromkeys(("start", "satellite", "solution", "stream", "set", "status", "load"), "as RTKRCV")

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.asked: list[Request] = []

    def handle(self, item: Any) -> None:
        """Nothing is subscribed."""

    def command(self, request: Request) -> Reply:
        self.asked.append(request)
        self.context.event(Level.INFO, "asked", f"was asked for {request.op}", logged=False)
        if request.op == "start":
            raise CommandError(Code.WRONG_STATE, "rtk server already started")
        if request.op == "stream":
            return Reply(ok=True, code=Code.OK, text="Stream\n" + "x" * 200_000 + "\n")
        texts = {
            "satellite": SATELLITE_HEAD.decode().strip("\r\n").removeprefix("\x1b[1m").removesuffix("\x1b[0m") + "\nG01 OK  100.0 45.0\n",
            "solution": f"2026/11/26 15:00:0{len(self.asked) % 10}.0  (FIX  ) N: 35 E: 139 H: 1.0 A: 0.0 R: 9.9 N: 9\n",
            "status": "Parameter                   : Value\nrtklib version              : rtkmesh\nrtk server state            : run\n",
        }
        return Reply(ok=True, code=Code.OK, message=f"{request.op} done", text=texts.get(request.op, ""))


class Solver:
    """The service above in a thread, on the network."""

    def __init__(self, site: Any) -> None:
        self.bus = site.bus("rtk")
        self.service = Told(Context(id="rtk", role=Role.SOLVER, deployment=SITE, bus=self.bus))
        self._life = Lifecycle(self.service, warm_in_thread=False)
        self._life.start()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._life.ended:
            self._life.step()

    def close(self) -> None:
        self._life.end("the test is over")
        self._thread.join(PATIENCE_S)
        self._life.finish()
        self.bus.close()
