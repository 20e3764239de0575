"""``rtkmesh up``: a deployment of light processes, its commands and its end."""

import os
import pty
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.e2e.conftest import Deployment, is_running
from tests.patience import PATIENCE_S, until

pytestmark = pytest.mark.e2e

TWO = "[monitor.one]\n[monitor.two]\n"
Up = Callable[..., Deployment]


def test_everything_starts_hub_first_and_ctrl_c_leaves_nothing(up: Up) -> None:
    deployment = up(TWO)
    deployment.until(deployment.all_running)
    started = [event["id"] for event in deployment.events if event.get("state") == "STARTING"]
    assert started[0] == "hub"
    assert set(started) == {"hub", "one", "two"}
    assert deployment.interrupt() == 0
    assert deployment.left() == []
    assert deployment.events[-1]["event"] == "end"


def test_sigterm_ends_it_as_ctrl_c_does(up: Up) -> None:
    deployment = up(TWO)
    deployment.until(deployment.all_running)
    assert deployment.interrupt(signal.SIGTERM) == 0
    assert deployment.left() == []


def test_sigterm_right_after_the_start_leaves_nothing(up: Up) -> None:
    deployment = up(TWO)
    deployment.until(lambda: any(event.get("pid") for event in deployment.events))
    deployment.interrupt(signal.SIGTERM)
    assert deployment.left() == []


def test_kill_9_of_control_leaves_no_orphan_even_when_one_is_frozen(up: Up) -> None:
    deployment = up(TWO)
    rows = deployment.until(deployment.all_running)
    os.kill(rows["one"]["pid"], signal.SIGSTOP)
    deployment.process.kill()
    until(lambda: not deployment.left())


def test_stop_is_respected_and_start_and_restart_act(up: Up) -> None:
    deployment = up(TWO)
    before = deployment.until(deployment.all_running)
    assert deployment.ask("control", "stop", id="one").ok
    deployment.until(lambda: deployment.rows()["one"]["state"] == "STOPPED")
    assert not is_running(before["one"]["pid"])
    assert deployment.ask("control", "restart", id="two").ok
    deployment.until(lambda: deployment.rows()["two"]["pid"] not in (0, before["two"]["pid"]))
    assert deployment.rows()["one"]["state"] == "STOPPED"
    assert deployment.ask("control", "start", id="all").ok
    deployment.until(deployment.all_running)


def test_wrong_commands_are_refused_with_what_there_is(up: Up) -> None:
    deployment = up(TWO)
    deployment.until(deployment.all_running)
    unknown = deployment.ask("control", "stop", id="nobody")
    assert not unknown.ok
    assert "hub, one, two" in unknown.message
    assert "id=ID" in deployment.ask("control", "stop").message
    assert not deployment.ask("control", "output", id="one", lines="many").ok
    deployment.until(lambda: any("RUNNING" in line for line in deployment.ask("control", "output", id="one").data["lines"]))


def test_reload_applies_only_what_has_changed(up: Up, tmp_path: Path) -> None:
    deployment = up(TWO)
    before = deployment.until(deployment.all_running)
    file = tmp_path / "deployment0.toml"
    text = file.read_text()
    file.write_text(text.replace("[monitor.one]\n", "[monitor.three]\n").replace("[monitor.two]", "[monitor.two]\nperiod_s = 2.0"))
    reply = deployment.ask("control", "reload")
    assert reply.ok
    assert reply.data == {"removed": ["one"], "added": ["three"], "restarted": ["two"]}
    after = deployment.until(lambda: (rows := deployment.all_running()) and "three" in rows and rows)
    assert set(after) == {"hub", "two", "three"}
    assert after["two"]["pid"] != before["two"]["pid"]
    assert after["hub"]["pid"] == before["hub"]["pid"]
    file.write_text(text + "[monitr.four]\n")
    wrong = deployment.ask("control", "reload")
    assert not wrong.ok
    assert "did you mean 'monitor'" in wrong.message
    file.write_text(text.replace('listen = ["tcp', 'listen = ["udp'))
    assert "new `rtkmesh up`" in deployment.ask("control", "reload").message


# (text of the file, instead of it, words of the answer)
BROKEN = [
    ("[monitor.two]", "[monitor.two", "no TOML"),
    ("[monitor.two]", "[monitor.two]\nperiod = 2", "did you mean 'period_s'"),
    ("[monitor.two]", "[monitor.two]\nperiod_s = -1", "> 0.05"),
    ("[monitor.two]", '[monitor.two]\n[ingest.rover]\nsource = "tpc://a:1"', "did you mean 'tcp'"),
    ("[monitor.two]", '[monitor.two]\n[ingest.rover]\nsource = "file://none.ubx"', "no such file"),
    ("[monitor.two]", '[monitor.two]\n[solver.rtk]\nrover = "rover"\nbase = "rover"', "no [ingest.rover]"),
    ("[monitor.two]", '[monitor.two]\n[ingest.rover]\nsource = "${RTKMESH_NO_SUCH_VARIABLE}"', "has no RTKMESH_NO_SUCH_VARIABLE"),
    ("[monitor.two]", "[monitor.two]\n# \udcff", "no UTF-8"),
]


def test_a_broken_file_leaves_everything_running(up: Up, tmp_path: Path) -> None:
    """Whatever is wrong with the file: reload says what, and no process is touched; the right file is taken afterwards."""
    deployment = up(TWO)
    before = deployment.until(deployment.all_running)
    file = tmp_path / "deployment0.toml"
    text = file.read_text()
    for good, broken, words in BROKEN:
        file.write_bytes(text.replace(good, broken).encode(errors="surrogateescape"))
        reply = deployment.ask("control", "reload")
        assert not reply.ok, broken
        assert reply.message.startswith("nothing is changed: "), reply.message
        assert words in reply.message
    file.unlink()
    assert "No such file" in deployment.ask("control", "reload").message
    assert {id_: row["pid"] for id_, row in deployment.rows().items()} == {id_: row["pid"] for id_, row in before.items()}
    file.write_text(text + "[monitor.three]\n")
    assert deployment.ask("control", "reload").data["added"] == ["three"]
    deployment.until(lambda: (rows := deployment.all_running()) and "three" in rows)


def test_busy_port_is_a_clear_error(up: Up, port: int) -> None:
    deployment = up(TWO)
    deployment.until(deployment.all_running)
    second = up(TWO)
    assert second.wait(PATIENCE_S) == 2
    assert f"tcp/127.0.0.1:{port} is taken" in second.text()
    assert second.left() == []
    assert deployment.all_running()


def test_wrong_file_is_named_with_line_and_nearest_key(up: Up) -> None:
    deployment = up("[monitor.one]\nperiod = 2.0\n")
    assert deployment.wait(PATIENCE_S) == 2
    assert "deployment0.toml:4" in deployment.text()
    assert "period_s" in deployment.text()


def test_top_away_from_a_terminal_prints_the_table_once(up: Up) -> None:
    deployment = up(TWO)
    deployment.until(deployment.all_running)
    command = [sys.executable, "-m", "rtkmesh_services.cli.main", "top", "--connect", deployment.endpoint]
    text = subprocess.run(command, capture_output=True, text=True, check=True, timeout=PATIENCE_S).stdout
    rows = [line.split()[:4] for line in text.splitlines()]
    for expected in (["hub", "hub"], ["one", "monitor"], ["two", "monitor"], ["control", "control"]):
        assert [*expected, "RUNNING", "RUNNING"] in rows


def test_table_on_a_terminal(tmp_path: Path, port: int) -> None:
    """On a terminal the live table is drawn, and Ctrl-C as typed there ends all with exit code 0."""
    file = tmp_path / "deployment.toml"
    file.write_text(f'[hub]\nlisten = ["tcp/127.0.0.1:{port}"]\n{TWO}')
    master, slave = pty.openpty()
    command = [sys.executable, "-m", "rtkmesh_services.cli.main", "up", str(file)]
    environment = {**os.environ, "TERM": "xterm-256color", "COLUMNS": "150", "LINES": "40"}
    process = subprocess.Popen(command, stdin=slave, stdout=slave, stderr=slave, env=environment, start_new_session=True)
    os.close(slave)
    seen, pressed = b"", False
    try:
        while data := _read(master):
            seen += data
            if not pressed and seen.count(b"RUNNING") >= 12:
                pressed = True
                process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE_S) == 0
    finally:
        process.kill()
        process.wait()
        os.close(master)
    text = seen.decode()
    assert "rtkmesh up deployment.toml" in text
    assert "monitor" in text
    assert "ended after" in text
    assert "Traceback" not in text


def _read(descriptor: int) -> bytes:
    try:
        return os.read(descriptor, 65536)
    except OSError:  # Linux says so when the last writer is gone
        return b""
