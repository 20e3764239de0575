"""The telnet console of a running deployment: a script for rtkrcv, and control that stops what it is told to stop."""

from collections.abc import Callable
from typing import Any

import pytest
from tests.services.old_script import STATUS_HEAD, OldScript, echo_of, run_old_script

SITE = """
[ingest.rover]
source = "sim://demo/rover?rate=1&seed=1"
[ingest.base]
source = "sim://demo/base?rate=1&seed=1"
[solver.rtk]
rover = "rover"
base = "base"
navigation = ["rover"]
frequencies = 1
[telnet.site]
solver = "rtk"
listen = "127.0.0.1:{port}"
password = "${{RTKMESH_TELNET_PASSWORD}}"
allow_shutdown = true
"""


@pytest.mark.e2e
def test_a_script_for_rtkrcv_runs_against_a_deployment(up: Callable[..., Any], free: int):
    """Login, screens, a cycle, farewell, as rtkrcv shows them; `shutdown` stops the solver's process and leaves the rest."""
    deployment = up(SITE.format(port=free), RTKMESH_TELNET_PASSWORD="secret")
    deployment.until(deployment.all_running, 120.0)
    deployment.until(lambda: deployment.ask("rtk", "solution").ok, 120.0)
    seen = run_old_script(free)
    assert seen["status"].startswith(echo_of(b"status") + STATUS_HEAD)
    assert b"\r\nrtk server state            : run\r\n" in seen["status"]
    assert seen["satellite"].startswith(echo_of(b"satellite") + b"\r\n\x1b[1mSAT C1    Az   El L1")
    assert seen["cycle"].endswith(b"\x1b[H\x1b[2J" + STATUS_HEAD)
    script = OldScript(free)
    script.log_in()
    assert script.ask(b"shut\r\n").endswith(b"unknown command: shut.\r\n")
    assert script.ask(b"shutdown\r\n").endswith(b"\r\nrtk server shutdown\r\n")
    deployment.until(lambda: deployment.rows()["rtk"]["state"] == "STOPPED")
    assert b"no process 'rtk'" in script.ask(b"status\r\n") or b"did not answer" in script.ask(b"status\r\n")
    script.send(b"exit\r\n")
    script.to_the_end()
    assert deployment.rows()["rover"]["state"] == "RUNNING"
    assert deployment.interrupt() == 0
    assert deployment.left() == []
