"""A running deployment, asked by a Skybrush client over TCP and by any Zenoh program over ``rtk/flockwave``."""

import json
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tests.e2e.conftest import Deployment, free_besides

from rtkmesh_schemas.keys import CONTROL_ID, FLOCKWAVE

pytestmark = pytest.mark.e2e

SITE = """
[flockwave]
tcp = "127.0.0.1:{port}"

[preset.field]
title = "Field"
format = "rtcm3"
sources = ["sim://demo/base?rate=5&seed=1"]
"""


class Client:
    """A line out, a line in; notifications are skipped."""

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=60.0)
        self.stream = self._socket.makefile("rwb")
        self._asked = 0

    def close(self) -> None:
        self.stream.close()
        self._socket.close()

    def ask(self, kind: str, **fields: Any) -> dict[str, Any]:
        self._asked += 1
        name = f"r{self._asked}"
        self.stream.write(json.dumps({"$fw.version": "1.0", "id": name, "body": {"type": kind, **fields}}).encode() + b"\n")
        self.stream.flush()
        while True:
            message = json.loads(self.stream.readline())
            if message.get("refs") == name:
                body: dict[str, Any] = message["body"]
                return body


def listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def test_a_running_base_is_told_to_skybrush_and_zenoh(up: Callable[..., Deployment], free: int, tmp_path: Path) -> None:
    """Selected by TCP, it gets a process of its own; its statistics are of real frames, and the same by both ways."""
    deployment = up(SITE.format(port=free), RTKMESH_STATE=str(tmp_path))
    deployment.until(deployment.all_running, 120.0)
    deployment.until(lambda: listens(free))
    client = Client(free)
    assert client.ask("SYS-VER")["software"] == "rtkmesh"
    assert client.ask("RTK-SOURCE", id="field") == {"type": "ACK-ACK"}

    def told() -> dict[str, Any] | None:
        found = client.ask("RTK-STAT")
        complete = found["antenna"].get("position") and found["cnr"] and "rtcm3/1077" in found["messages_tx"]
        return found if complete else None

    first = deployment.until(told, 120.0)
    assert first["messages"]["rtcm3/1077"][0] < 1000.0
    assert len(first["cnr"]) > 10
    [answer] = deployment.bus.get(FLOCKWAVE.key(CONTROL_ID), payload=b'{"type": "X-RTK-STAT"}', encoding="application/json", timeout_s=15.0)
    second = json.loads(answer.payload)
    assert (second["type"], second["antenna"]) == ("X-RTK-STAT", first["antenna"])
    assert set(second["messages"]) >= set(first["messages"])
    refusal = client.ask("RTK-SURVEY", settings={"accuracy": 1.0, "duration": 60})
    assert refusal["reason"] == "a source of format rtcm3 takes no orders: field cannot be surveyed (auto and ubx can)"
    client.close()
    assert deployment.interrupt() == 0
    assert deployment.left() == []


def test_a_port_that_is_taken_ends_the_start_with_a_word(up: Callable[..., Deployment], port: int) -> None:
    """Exit code 2, and the address."""
    taken = free_besides(port)
    with socket.create_server(("127.0.0.1", taken)):
        deployment = up(f'[flockwave]\ntcp = "127.0.0.1:{taken}"\n[monitor.one]\n')
        assert deployment.wait(60.0) == 2
    assert f"[flockwave] 127.0.0.1:{taken}: Address already in use" in deployment.text()
