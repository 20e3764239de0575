"""The runtime with real processes over real Zenoh: ends, crashes, hangs, restarts of the hub, calls."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import zenoh
from tests.patience import PATIENCE_S, shortest_s

from rtkmesh_schemas.command import Code
from rtkmesh_schemas.keys import CMD, CREDIT, EPH, EVENT, OBS, SOL_TEXT, STATUS
from rtkmesh_schemas.status import Event, ServiceStatus, State
from rtkmesh_schemas.wire import decode
from rtkmesh_services.errors import UnreachableError
from rtkmesh_services.runtime.bus import Sample
from rtkmesh_services.runtime.calls import call
from rtkmesh_services.runtime.inbox import Inbox
from rtkmesh_services.runtime.process import END_S
from rtkmesh_services.runtime.zenoh_bus import ZenohBus, open_bus, session_config

pytestmark = pytest.mark.e2e
KNOWN = b"known"


def ended(process: subprocess.Popen[str]) -> tuple[int, str]:
    """Return (exit code, stderr) of a process that ends. How long it may take to end it watches itself: exit code 75 if longer."""
    _, error = process.communicate(timeout=PATIENCE_S)
    return process.returncode, error


def told_until(inbox: Inbox, last: Callable[[Sample], bool]) -> list[Sample]:
    """Return what has come, up to the first that is the last of interest."""
    samples: list[Sample] = []
    while not (samples and last(samples[-1])):
        sample = inbox.get(PATIENCE_S)
        assert sample is not None
        samples.append(sample)
    return samples


def state_of(sample: Sample) -> State:
    return decode(ServiceStatus, sample.payload).state


def do(bus: ZenohBus, op: str, name: str = "p", **arguments: Any) -> None:
    """Ask the process under test to misbehave."""
    [reply] = call(bus, name, op, arguments, 5.0)
    assert reply.ok, reply


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_a_service_with_callbacks_in_two_seconds(site: Any, number: signal.Signals):
    """Exit code 0, a last status STOPPED with the reason, no token left."""
    with site.bus() as bus:
        seen = Inbox()
        bus.subscribe(STATUS.key("p"), seen.put)
        process = site.process("p")
        site.is_running(bus, "p")
        process.send_signal(number)
        code, error = ended(process)
        assert (code, END_S < 2.0) == (0, True), error
        last = told_until(seen, lambda sample: state_of(sample) is State.STOPPED)[-1]
        assert decode(ServiceStatus, last.payload).reason == number.name
        site.until(lambda: "p" not in bus.live())


def test_a_signal_ends_a_service_that_waits_for_the_hub(fleet: Any):
    """Opening the session may wait for ever, the process not."""
    process = fleet.process("p")
    fleet.until(lambda: _has_handler(process.pid, signal.SIGTERM))
    process.send_signal(signal.SIGTERM)
    assert ended(process)[0] == 0


def _has_handler(pid: int, number: signal.Signals) -> bool:
    """Return whether a process catches a signal (Linux, /proc)."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    caught = next(int(line.split()[1], 16) for line in lines if line.startswith("SigCgt"))
    return bool(caught >> (number - 1) & 1)


def test_a_second_process_of_an_id_ends_and_the_first_stays(site: Any):
    """It names the other one; the first still answers."""
    with site.bus() as bus:
        first = site.process("p")
        site.is_running(bus, "p")
        code, error = ended(site.process("p"))
        assert code == 2
        assert f"another process has the id 'p': a solver, pid {first.pid} on " in error
        do(bus, "publish", count=1)
        assert first.poll() is None


@pytest.mark.parametrize(("op", "words"), [("crash", "told to crash"), ("crash_thread", "told to crash in a thread")])
def test_an_uncaught_exception_ends_the_process_with_70(site: Any, op: str, words: str):
    """No zombie that still answers: an event, the traceback, a FAILED status, gone."""
    with site.bus() as bus:
        events, statuses = Inbox(), Inbox()
        bus.subscribe(EVENT.key("p", level="error"), events.put)
        bus.subscribe(STATUS.key("p"), statuses.put)
        process = site.process("p")
        site.is_running(bus, "p")
        do(bus, op)
        code, error = ended(process)
        assert code == 70
        assert "Traceback" in error
        assert words in error
        codes = [code_of(sample) for sample in told_until(events, lambda sample: code_of(sample) == "state_failed")]
        assert codes == ["crashed", "state_failed"]
        last = told_until(statuses, lambda sample: state_of(sample) is State.FAILED)[-1]
        assert words in decode(ServiceStatus, last.payload).reason
        site.until(lambda: "p" not in bus.live())


def code_of(sample: Sample) -> str:
    return decode(Event, sample.payload).code


def test_a_fault_of_the_site_ends_with_2(site: Any):
    """A missing device or a wrong file is not a bug: another exit code."""
    with site.bus() as bus:
        process = site.process("p")
        site.is_running(bus, "p")
        do(bus, "site")
        assert ended(process)[0] == 2


@pytest.mark.parametrize(("op", "code"), [("hang", 75), ("hang_close", 75), ("burn", 0)])
def test_an_end_that_hangs_is_cut_off(site: Any, op: str, code: int):
    """A loop in C code, a device that does not close, a thread that does not end: cut off by the process itself, after ``END_S``."""
    with site.bus() as bus:
        process = site.process("p")
        site.is_running(bus, "p")
        do(bus, op)
        if op == "hang":
            site.until(lambda: call(bus, "p", "status", {}, 0.2)[0].code is Code.HUNG)
        process.send_signal(signal.SIGTERM)
        assert ended(process)[0] == code


def test_shutdown_by_command(site: Any):
    """``shutdown`` answers, then the process ends with 0."""
    with site.bus() as bus:
        process = site.process("p")
        site.is_running(bus, "p")
        do(bus, "shutdown")
        assert ended(process)[0] == 0


def test_the_parent_s_death_is_the_child_s(site: Any):
    """No orphans, also when the parent is killed with -9."""
    with site.bus() as bus:
        script = (
            "import os, subprocess, sys, time; "
            "subprocess.Popen(sys.argv[1:], env={**os.environ, 'RTKMESH_PARENT': str(os.getpid())}); time.sleep(60)"
        )
        parent = site.start("-c", script, sys.executable, str(site.under_test), str(site.config), "p")
        pid = site.is_running(bus, "p").pid
        assert pid != parent.pid
        parent.kill()
        site.until(lambda: not _alive(pid))


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return "\nState:\tZ" not in Path(f"/proc/{pid}/status").read_text()


def test_commands_are_answered_within_100_ms_while_warming(site: Any):
    """The process is asked while it compiles; it is not alive for others until it is open."""
    with site.bus() as bus:
        begin = site.folder / "begin"
        site.process("p", str(begin))
        site.status_until(bus, "p", lambda status: status.state is State.WARMING)
        assert "p" not in bus.live()
        times: list[float] = []
        for _ in range(20):
            began = time.monotonic()
            [answer] = bus.get(CMD.key("p") + "?op=status", timeout_s=10.0)
            times.append(time.monotonic() - began)
            assert json.loads(answer.payload)["state"] == "WARMING"
        assert sorted(times)[10] < 0.1
        begin.touch()
        site.is_running(bus, "p")
        site.until(lambda: bus.live().get("p") == "solver")


def test_call_names_what_is_wrong(site: Any):
    """Absent, hung (SIGSTOP) and all others, by real processes."""

    def asked_while_it_stands(name: str, expected: list[tuple[str, Code]]) -> bool:
        second.send_signal(signal.SIGSTOP)
        replies = call(bus, name, "status", {}, 0.5)
        second.send_signal(signal.SIGCONT)  # before its lease of 2 s is over
        return [(reply.id, reply.code) for reply in replies] == expected

    with site.bus() as bus:
        first, second = site.process("a"), site.process("b")
        site.is_running(bus, "a")
        site.is_running(bus, "b")
        site.until(lambda: set(bus.live()) == {"a", "b", "hub"})
        assert [(reply.id, reply.ok) for reply in call(bus, "*", "status", {}, 10.0)] == [("a", True), ("b", True), ("hub", True)]
        [reply] = call(bus, "c", "status", {}, 0.3)
        assert (reply.code, "a, b, hub" in reply.message) == (Code.ABSENT, True)
        site.until(lambda: asked_while_it_stands("b", [("b", Code.HUNG)]))
        site.until(lambda: asked_while_it_stands("*", [("a", Code.OK), ("b", Code.HUNG), ("hub", Code.OK)]))
        second.send_signal(signal.SIGSTOP)
        site.until(lambda: "b" not in bus.live())
        second.send_signal(signal.SIGCONT)
        site.until(lambda: "b" in bus.live())
        assert call(bus, "b", "status", {}, 10.0)[0].ok
        first.kill()
        site.until(lambda: "a" not in bus.live())


def test_any_zenoh_program_can_ask(site: Any):
    """A plain get: JSON, msgpack, parameters, all at once with a wildcard."""
    with site.bus() as bus:
        site.process("p")
        site.is_running(bus, "p")
    with zenoh.open(session_config("client", connect=[site.endpoint])) as session:
        [reply] = session.get("rtk/p/cmd", payload='{"op":"status","request_id":"7"}', encoding="application/json", timeout=10.0)
        assert str(reply.ok.encoding) == "application/json;rtkmesh.Reply/1"
        answer = json.loads(reply.ok.payload.to_string())
        assert (answer["ok"], answer["state"], answer["request_id"], answer["id"]) == (True, "RUNNING", "7", "p")
        [reply] = session.get("rtk/p/cmd?op=help", timeout=10.0)
        assert "crash" in json.loads(reply.ok.payload.to_string())["data"]["operations"]
        [reply] = session.get("rtk/p/cmd", payload=b"\x81\xa2op\xa6status", timeout=10.0)
        assert str(reply.ok.encoding) == "application/msgpack;rtkmesh.Reply/1"
        keys = {str(reply.ok.key_expr) for reply in session.get("rtk/*/cmd?op=status", timeout=10.0)}
        assert keys == {"rtk/p/cmd", "rtk/hub/cmd"}
        [reply] = session.get("rtk/p/cmd?op=fly", timeout=10.0)
        assert json.loads(reply.err.payload.to_string())["code"] == "unknown_op"
        [reply] = session.get("rtk/p/cmd", payload=b"x" * 20_000, timeout=10.0)
        assert json.loads(reply.err.payload.to_string())["code"] == "too_large"
        assert list(session.get("rtk/p/cmd", payload=b"x" * 80_000, timeout=2.0)) == []  # the hub's limit of 64 KiB
        [reply] = session.get("rtk/p/latest?what=status", timeout=10.0)
        assert json.loads(reply.ok.payload.to_string())["status"]["id"] == "p"


def test_a_late_joiner_gets_what_is_cached(site: Any):
    """Ephemerides and status come at once, with all that was published before; events too."""
    with site.bus("rover") as rover:
        for number in range(3):
            for satellite in ("G01", "E02"):
                rover.publish(EPH, f"{satellite} {number}", satellite=satellite)
        with site.bus("late") as late:
            inbox = Inbox()
            late.subscribe("rtk/rover/eph/*", inbox.put, history=True)
            got: list[str] = []
            while not {"E02 2", "G01 2"} <= set(got):  # what was still on its way comes live, behind what was cached before it
                got.append(inbox.get(PATIENCE_S).payload.decode())
            for satellite in ("G01", "E02"):
                assert [word[-1] for word in got if word.startswith(satellite)][-2:] == ["1", "2"]
            rover.publish(EPH, "G01 3", satellite="G01")
            assert inbox.get(PATIENCE_S).payload == b"G01 3"
            statuses = Inbox()
            late.subscribe("rtk/hub/status", statuses.put, history=True)
            assert decode(ServiceStatus, statuses.get(PATIENCE_S).payload).id == "hub"


def test_order_is_kept_over_subscriptions_and_between_cached_and_plain_streams(site: Any):
    """An ephemeris that follows an epoch arrives after it: what a receiver sends keeps its order."""
    with site.bus("rover") as rover, site.bus("solver") as solver:
        seen: list[int] = []
        known: set[str] = set()
        done = threading.Event()

        def note(sample: Sample) -> None:
            if sample.payload == KNOWN:
                known.add(sample.key)
                return
            seen.append(int(sample.payload))
            if len(seen) == 600:
                done.set()

        solver.subscribe("rtk/rover/eph/*", note, history=True)
        solver.subscribe("rtk/rover/obs", note)
        attached = threading.Event()
        rover.subscribe("rtk/rover/credit", lambda sample: attached.set() if sample.payload == b"ready" else None)
        site.until(lambda: _announced(solver, attached))
        for number in range(32):  # what a new key sends first is held back while its history is asked for; the sequencer knows of that
            rover.publish(EPH, KNOWN.decode(), satellite=f"G{number:02d}")
        site.until(lambda: len(known) == 32)
        for number in range(600):
            if number % 3 == 0:
                rover.publish(EPH, str(number), satellite=f"G{number % 32:02d}")
            else:
                rover.publish(OBS, str(number))
        assert done.wait(PATIENCE_S)
        assert seen == list(range(600))


def _announced(solver: ZenohBus, attached: threading.Event) -> bool:
    """Say that the subscriptions stand, as a consumer of a replay does; they went before on the same link."""
    solver.publish_as("rover", CREDIT, b"ready")
    return attached.wait(0.1)


def _sleep(sample: Sample) -> None:
    assert sample.payload
    time.sleep(0.2)


def test_a_slow_subscriber_slows_nobody(site: Any):
    """A foreign callback that sleeps: the producer's publishes stay short, another subscriber gets all."""
    with site.bus("slow") as slow, site.bus("quick") as quick:
        slow.subscribe("rtk/p/sol/flood", _sleep)
        inbox = Inbox(capacity=5000)
        quick.subscribe("rtk/p/sol/flood", inbox.put)
        site.process("p")
        site.is_running(quick, "p")
        for _ in range(4):  # what the hub keeps for one that stands still holds 500
            do(quick, "publish", count=500)
            numbers = [int(inbox.get(PATIENCE_S).payload[1000:]) for _ in range(500)]
            assert numbers == list(range(500))
        [reply] = call(quick, "p", "status", {}, 10.0)
        assert reply.data["data"]["long_publishes"] < 5, "a machine that stands still makes one of them long, a full queue hundreds"
        assert reply.data["counters"]["not_sent"] == 0


def test_a_killed_hub_comes_back_and_all_flows_again(fleet: Any):
    """kill -9 of the hub: within a second of its return data, tokens, commands and cached messages are back."""
    hub = fleet.hub()
    with fleet.bus("rover") as rover, fleet.bus("solver") as solver:
        fleet.process("p")
        fleet.is_running(solver, "p")
        inbox, eph = Inbox(), Inbox()
        solver.subscribe("rtk/rover/obs", inbox.put)
        solver.subscribe("rtk/rover/eph/*", eph.put, history=True)
        rover.publish(EPH, "before", satellite="G01")
        assert eph.get(PATIENCE_S).payload == b"before"
        outages_s: list[float] = []
        while not outages_s or (min(outages_s) > 1.0 and len(outages_s) < 4):  # the machine may stand still in one of them
            hub = outage(fleet, hub, rover, solver)
            back = time.monotonic()
            while inbox.get(0.02) is None:
                rover.publish(OBS, "x")
                assert time.monotonic() - back < PATIENCE_S
            outages_s.append(time.monotonic() - back)
            assert eph.get(PATIENCE_S).payload == b"during"
            fleet.until(lambda: "p" in solver.live())
            assert call(solver, "p", "status", {}, 10.0)[0].ok
            drained(inbox)
        assert min(outages_s) < 1.0


def outage(fleet: Any, hub: subprocess.Popen[str], rover: ZenohBus, solver: ZenohBus) -> subprocess.Popen[str]:
    """Kill the hub, publish what is cached meanwhile, and return the next one."""
    hub.kill()
    hub.wait()
    fleet.until(lambda: not rover.connected() and not solver.connected())
    rover.publish(EPH, "during", satellite="G01")
    started: subprocess.Popen[str] = fleet.hub()
    return started


def drained(inbox: Inbox) -> None:
    while inbox.get(0.0) is not None:
        pass


def test_no_hub_is_said_quickly(fleet: Any):
    """A read command does not hang on an absent network."""

    def ask() -> None:
        with pytest.raises(UnreachableError, match="is it running"):
            open_bus("x", [fleet.endpoint], timeout_s=0.2)

    assert shortest_s(ask, 1.5) < 1.5


def test_a_busy_port_is_a_clear_error(site: Any):
    """Two hubs on one address: the second says so and ends with 2."""
    second = site.rtkmesh("run", "hub", "--config", str(site.config))
    code, error = ended(second)
    assert code == 2
    assert "in use" in error


def test_the_namespace_keeps_sites_apart(fleet: Any):
    """Two sites on one network do not see each other; keys in code are the same."""
    fleet.namespace = "site1"
    fleet.hub()
    with fleet.bus("a") as one, open_bus("b", [fleet.endpoint], namespace="site2", timeout_s=PATIENCE_S) as two:
        first, other = Inbox(), Inbox()
        one.subscribe("rtk/*/sol/*", first.put)
        two.subscribe("rtk/*/sol/*", other.put)
        with fleet.bus("c") as sender:
            fleet.until(lambda: sender.matched(SOL_TEXT, format="llh"))
            sender.publish(SOL_TEXT, "hello", format="llh")
        sample = first.get(PATIENCE_S)
        assert (sample.key, sample.payload) == ("rtk/c/sol/llh", b"hello")
        assert other.get(0.2) is None
        assert "hub" in one.live()
        assert two.live() == {}


def test_closing_is_quick_and_complete(site: Any, caplog: pytest.LogCaptureFixture):
    """Everything declared is taken back; a closed bus neither raises nor sends."""
    with site.bus("watcher") as watcher, site.bus("a") as bus:
        bus.live_token("solver", "a")
        bus.queryable(CMD.key("a"), lambda query: query.reply(b"{}", "application/json"))
        bus.publish(EPH, "x", satellite="G01")
        bus.subscribe("rtk/**", list[Sample]().append)
        site.until(lambda: watcher.live().get("a") == "solver")
        bus.close()
        bus.close()
        assert "did not close within" not in caplog.text
        bus.publish(EPH, "y", satellite="G01")
        assert bus.counters["not_sent"] == 1
        site.until(lambda: "a" not in watcher.live())
        assert watcher.get(CMD.key("a"), timeout_s=1.0) == []
