"""A replay begins when those who take the solutions are there: none of the first ones is lost."""

import pytest

from rtkmesh_schemas.config import AttitudeTable, Deployment, IngestTable, OutputTable, SolverTable
from rtkmesh_schemas.errors import ConfigError
from rtkmesh_schemas.keys import CREDIT, SOL, Role
from rtkmesh_services.runtime.clock import ManualClock
from rtkmesh_services.runtime.lifecycle import Lifecycle
from rtkmesh_services.runtime.memory_bus import MemoryBus, MemoryNetwork
from rtkmesh_services.runtime.service import Context
from rtkmesh_services.solver.service import FOLLOWERS_S, SolverService


class Replay:
    """A solver of two recordings on an in-memory bus."""

    def __init__(self, **options: object) -> None:
        self.network, self.clock = MemoryNetwork(), ManualClock()
        deployment = Deployment(
            ingest={name: IngestTable(source=f"file://{name}.ubx") for name in ("rover", "base")},
            solver={"rtk": SolverTable(rover="rover", base="base", **options)},  # pyright: ignore[reportArgumentType]  any option
            attitude={"heading": AttitudeTable(solver="rtk")},
            output={"pos": OutputTable(solver="rtk", target="file://x.pos"), "other": OutputTable(solver="else", target="file://y")},
        )
        self.bus = MemoryBus("rtk", self.network)
        self.life = Lifecycle(
            SolverService(Context(id="rtk", role=Role.SOLVER, deployment=deployment, bus=self.bus, clock=self.clock)),
            warm_in_thread=False,
        )
        self.life.start()
        self.step(0.1)

    def step(self, seconds: float) -> None:
        self.clock.advance(seconds)
        for _ in range(2):
            self.life.step(0.0)

    @property
    def is_ready(self) -> bool:
        """Whether the solver has told its receivers that it takes their streams."""
        return any(sample.key == CREDIT.key("rover") for sample in self.network.sent)


def test_a_replay_waits_for_outputs_and_attitudes() -> None:
    """Ready when both are alive and the solutions are subscribed to, and at once then."""
    replay = Replay()
    taker = MemoryBus("pos", replay.network)
    taker.live_token("output", "pos")
    taker.live_token("attitude", "heading")
    replay.step(1.0)
    assert not replay.is_ready
    taker.subscribe(SOL.key("rtk"), lambda _: None)
    replay.step(0.1)
    assert replay.is_ready


def test_a_follower_that_never_comes_is_waited_for_only_so_long() -> None:
    """An output that failed or is not run must not hold the replay for ever."""
    replay = Replay()
    replay.step(FOLLOWERS_S - 1.0)
    assert not replay.is_ready
    replay.step(1.0)
    assert replay.is_ready


def test_options_that_the_engine_refuses_are_the_sites_fault() -> None:
    """Then the process is not started again and again (exit code 2)."""
    with pytest.raises(ConfigError, match="G99"):
        Replay(excluded=("G99",))
