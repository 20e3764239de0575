"""Every word of RTKRCV asked of a running deployment: real processes, real Zenoh."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tests.e2e.conftest import Deployment
from tests.patience import all_but_a_few

from rtkmesh_schemas.keys import SCREEN
from rtkmesh_schemas.status import State
from rtkmesh_services.solver.words import OPERATIONS

pytestmark = [pytest.mark.e2e, pytest.mark.slow, pytest.mark.usefixtures("compiled")]

DEPLOYMENT = """
[ingest.rover]
source = "sim://static/rover?rate=5"

[ingest.base]
source = "sim://static/base?rate=5"

[solver.rtk]
rover = "rover"
base = "base"

[output.pos]
solver = "rtk"
target = "file://{folder}/track.pos"
"""
# In an order in which each can be done; what goes last begins anew.
WORDS: dict[str, dict[str, Any]] = {
    "status": {}, "solution": {"count": 3}, "satellite": {}, "observ": {}, "navidata": {}, "stream": {}, "error": {}, "option": {},
    "set": {"name": "pos1-elmask", "value": "12"}, "mode": {"mode": "static"}, "mark": {"name": "pole"}, "save": {"file": "words.toml"},
    "load": {"file": "words.toml"}, "log": {}, "help": {}, "stop": {}, "start": {}, "restart": {},
}  # fmt: skip


def test_every_word_of_a_running_solver(up: Callable[..., Deployment], tmp_path: Path) -> None:
    """Each is answered with its text, fast; the fix outlives all that is done to the running filter."""
    deployment = up(DEPLOYMENT.replace("{folder}", str(tmp_path)))
    fixes = deployment.fixes("rtk")
    deployment.until(lambda: len(fixes) > 20, 120.0)
    statuses = deployment.statuses()
    deployment.until(lambda: {"rover", "base", "pos"} <= set(statuses))
    screens: dict[str, str] = {}
    handle = deployment.bus.subscribe(SCREEN.key("rtk", word="*"), lambda s: screens.update({s.key.split("/")[-1]: s.payload.decode()}))
    assert set(WORDS) >= set(OPERATIONS)
    took_s, resets = list[float](), fixes[-1].resets  # a filter of the first epochs' few satellites may have begun anew
    for word, args in WORDS.items():
        before, began = len(fixes), time.monotonic()
        reply = deployment.ask("rtk", word, **args)
        took_s.append(time.monotonic() - began)
        assert reply.ok, (word, reply.message)
        if word not in ("stop", "start", "restart"):
            deployment.until(lambda before=before: len(fixes) > before + 2)
            assert fixes[-1].resets == resets
        if word in ("set", "mode", "load"):
            assert reply.data["applied"] == "at_once"
    assert all_but_a_few(took_s) < 1.0
    rows = {row["name"]: row for row in deployment.ask("rtk", "stream").data["streams"]}
    assert [rows[name]["state"] for name in ("input rover", "input base", "output sol1")] == ["C", "C", "C"]
    wanted = {"status", "satellite", "observ", "navidata", "stream", "solution"}
    deployment.until(lambda: wanted <= set(screens))
    assert screens["status"].count("\n") == 47, "RTKRCV's parameters"
    handle.close()
    assert deployment.ask("pos", "satellite").message == "satellite is a word of solvers: ask rtk"
    started = statuses["rtk"].start_id
    assert deployment.ask("rtk", "shutdown").ok
    deployment.until(lambda: statuses["rtk"].start_id != started and statuses["rtk"].state is State.RUNNING, 60.0)
