"""When `up --exit-at-end` ends: recordings solved, and every attitude through with what was solved, however slow it is."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from rtkmesh_schemas.status import InputStatus, ServiceStatus, State
from rtkmesh_services.cli import up
from rtkmesh_services.cli.board import Board
from rtkmesh_services.runtime.configuration import load_site

TEXT = """
[ingest.rover]
source = "file:rover.ubx"

[ingest.base]
source = "file:base.ubx"

[solver.vector]
rover = "rover"
base = "base"
mode = "moving-base"

[attitude.body]
solver = "vector"
"""


class World:
    """A board that is told states, at times that the test says, and the end that is asked."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        file = folder / "body.toml"
        file.write_text(TEXT)
        self.now_s, self.board = 0.0, Board()
        monkeypatch.setattr(up, "time", SimpleNamespace(monotonic=lambda: self.now_s))
        self._end = up.AtEnd(load_site(file))
        self._heartbeats: dict[str, int] = {}

    def tell(self, id_: str, role: str, taken: int = 0, **data: Any) -> None:
        beat = self._heartbeats[id_] = self._heartbeats.get(id_, 0) + 1
        inputs = [InputStatus(name="vector", state="receiving", messages=taken)]
        self.board.statuses[id_] = (
            ServiceStatus(id=id_, role=role, state=State.RUNNING, start_id="a", heartbeat=beat, inputs=inputs, data=data),
            0,
        )

    def second(self, taken: int, *, played: bool = True, solved: bool = True) -> tuple[str, int] | None:
        """A second goes by in which an attitude has come to ``taken`` messages; return what is said of the end."""
        self.now_s += 1.0
        self.tell("rover", "ingest", end=played)
        self.tell("base", "ingest", end=played)
        self.tell("vector", "solver", end=solved)
        self.tell("body", "attitude", taken)
        return self._end(cast("up.Foreground", SimpleNamespace(board=self.board, processes=list[dict[str, Any]])))


@pytest.fixture
def world(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> World:
    return World(tmp_path, monkeypatch)


def test_an_attitude_that_lags_by_half_a_minute_is_waited_for(world: World) -> None:
    assert [world.second(10 * k) for k in range(1, 40)] == [None] * 39
    found = [world.second(390) for _ in range(3)]
    assert found[-1] == ("all recordings are at their end", 0)


def test_it_does_not_end_while_receivers_are_played(world: World) -> None:
    assert [world.second(10, played=False, solved=False) for _ in range(60)] == [None] * 60


def test_a_solver_that_never_says_so_is_told_as_a_failure(world: World) -> None:
    found = [world.second(10, solved=False) for _ in range(20)]
    assert found[-1] == ("all recordings are at their end, but vector did not finish", 1)
