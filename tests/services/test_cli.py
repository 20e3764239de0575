"""The commands of daily use: what they print, what their exit codes say, how quick they are."""

import json
import os
import resource
import subprocess
import sys
from math import inf, nan
from pathlib import Path
from typing import Any

import pytest

from rtkmesh_schemas.command import Code, Reply
from rtkmesh_schemas.observation import Observation
from rtkmesh_schemas.status import ServiceStatus, State
from rtkmesh_schemas.wire import encode, encoding_of
from rtkmesh_services.cli.check import check
from rtkmesh_services.cli.cmd import show_reply
from rtkmesh_services.cli.echo import full_expression, line_of, page_of
from rtkmesh_services.cli.main import COMMANDS
from rtkmesh_services.cli.network import EXIT_FAILED, EXIT_REFUSED, EXIT_TIMEOUT, EXIT_UNREACHABLE, EXIT_USAGE, exit_code
from rtkmesh_services.cli.show import keys, schema
from rtkmesh_services.cli.status import show_status, status_exit_code, unanswering
from rtkmesh_services.cli.up import Foreground
from rtkmesh_services.control.fleet import LaunchOptions
from rtkmesh_services.runtime.bus import Sample
from rtkmesh_services.runtime.configuration import load_site
from rtkmesh_services.runtime.console_words import WordError, arguments
from rtkmesh_services.runtime.shipped import config_path


def rtkmesh(*words: str) -> "subprocess.CompletedProcess[str]":
    """Run the command to its end."""
    argv = [sys.executable, "-m", "rtkmesh_services.cli.main", *words]
    return subprocess.run(argv, capture_output=True, text=True, check=False, timeout=60, stdin=subprocess.DEVNULL)


@pytest.mark.parametrize(
    ("op", "words", "values"),
    [
        ("load", ("night.toml",), {"file": "night.toml"}),
        ("load", ("file=night.toml",), {"file": "night.toml"}),
        ("set", ("elevation_mask_deg", "15.5"), {"key": "elevation_mask_deg", "value": 15.5}),
        ("x", ("n=3", "flag=true", "name=a b"), {"n": 3, "flag": True, "name": "a b"}),
        ("x", ("list=[1,2]", "expr=a=b"), {"list": [1, 2], "expr": "a=b"}),
        ("restart", ("rover",), {"id": "rover"}),
        ("x", ("a=NaN", "b=9" + "9" * 20, "c=1e999"), {"a": "NaN", "b": "9" * 21, "c": "1e999"}),
        ("status", (), {}),
    ],
)  # fmt: skip
def test_words_become_arguments(op: str, words: tuple[str, ...], values: dict[str, Any]):
    """name=value, or a bare word where one is usual; numbers, true and lists are such."""
    assert arguments(op, words) == values


def test_a_word_too_many_is_said():
    """A bare word where none belongs is a mistake, not an argument without a name."""
    with pytest.raises(WordError, match="is no argument of load"):
        arguments("load", ("a.toml", "b.toml"))


@pytest.mark.parametrize(
    ("codes", "expected"),
    [
        ([Code.OK, Code.ACCEPTED], 0),
        ([], EXIT_UNREACHABLE),
        ([Code.ABSENT], EXIT_UNREACHABLE),
        ([Code.OK, Code.HUNG], EXIT_TIMEOUT),
        ([Code.REFUSED], EXIT_REFUSED),
        ([Code.NOT_ALLOWED], EXIT_REFUSED),
        ([Code.UNKNOWN_OP], EXIT_USAGE),
        ([Code.BAD_ARGUMENTS], EXIT_USAGE),
        ([Code.FAILED], EXIT_FAILED),
        ([Code.WRONG_STATE], EXIT_FAILED),
    ],
)
def test_exit_codes(codes: list[Code], expected: int):
    """The first failure decides."""
    assert exit_code([Reply(ok=code in {Code.OK, Code.ACCEPTED}, code=code) for code in codes]) == expected


def test_every_failure_code_has_an_exit_code_that_is_not_success():
    """No failure ends with 0."""
    assert all(exit_code([Reply(ok=False, code=code)]) != 0 for code in Code)


@pytest.mark.parametrize(
    ("text", "expression"),
    [
        ("rover/sol", "rtk/rover/sol"),
        ("rtk/rover/sol", "rtk/rover/sol"),
        ("rtk/sol", "rtk/rtk/sol"),
        ("rtk/rtk/sol", "rtk/rtk/sol"),
        ("*/status", "rtk/*/status"),
        ("rtk/**", "rtk/**"),
        ("**", "**"),
        ("rover/eph/*", "rtk/rover/eph/*"),
        ("rtk/flockwave", "rtk/flockwave"),
    ],
)
def test_echo_knows_what_is_meant(text: str, expression: str):
    """With or without the leading rtk/, also for a process that is called rtk."""
    assert full_expression(text) == expression


def observation() -> Sample:
    """Return an epoch as it is on the bus."""
    column = b"\x00\x00\x00\x00\x00\x00\xf8\x3f" * 2  # 1.5
    message = Observation(
        source="rover", start_id="s", sequence=1, week=2200, tow_s=1.0, satellite=["G01", "R02"], signal=["1C", "1C"],
        channel=b"\x7f\xff", flags=b"\x00\x03", pseudorange_m=column, phase_cyc=column, doppler_hz=column, cn0_dbhz=column,
        lock_s=column, pseudorange_sigma_m=column, phase_sigma_cyc=column,
    )  # fmt: skip
    return Sample("rtk/rover/obs", encode(message), encoding_of(Observation), b"", 0)


def test_echo_decodes_our_messages():
    """The columns of an epoch are numbers, not bytes."""
    value = json.loads(line_of(observation()))["value"]
    assert (value["satellite"], value["channel"], value["flags"], value["cn0_dbhz"]) == (["G01", "R02"], [127, -1], [0, 3], [1.5, 1.5])
    assert "cn0_dbhz: [1.5,1.5]" in page_of(observation())


def test_echo_tells_what_is_not_bounded_from_what_is_not_known():
    """For people; JSON has null for both."""
    message = ServiceStatus(
        id="a", role="solver", state=State.RUNNING, start_id="s", heartbeat=1, data={"levels": [inf, nan, -0.5, None, "x"]}
    )
    page = page_of(Sample("rtk/a/status", encode(message), encoding_of(ServiceStatus), b"", 0))
    assert 'data: {"levels":[inf,nan,-0.5,null,"x"]}' in page


def test_echo_shows_foreign_messages_raw_and_harmless():
    """Text as text without control characters, bytes as hexadecimal; damaged messages of ours too."""
    assert "hello �[31m" in page_of(Sample("rtk/a/sol/llh", b"hello \x1b[31m", "text/plain", b"", 0))
    assert json.loads(line_of(Sample("x/y", b"\x01\x02", "", b"", 0)))["hex"] == "0102"
    assert json.loads(line_of(Sample("rtk/rover/obs", b"\xc1", "", b"", 0)))["hex"] == "c1"


def test_check_lists_all_faults(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Also those of the sources' URLs, with the line; JSON for programs."""
    file = tmp_path / "d.toml"
    file.write_text('[ingest.a]\nsource = "seral:///dev/ttyACM0"\n[ingest.b]\nsource = "file://nothing.ubx"\n')
    assert check(file) == EXIT_USAGE
    error = capsys.readouterr().err
    assert f"{file}:2: [ingest.a] source: " in error
    assert "'serial'" in error
    assert f"{file}:4: [ingest.b] source: 'nothing.ubx': no such file" in error
    assert check(file, as_json=True) == EXIT_USAGE
    assert [row["line"] for row in json.loads(capsys.readouterr().out)["errors"]] == [2, 4]
    file.write_text('[ingest.a]\nsource = "sim://demo/bow"\n[ingest.b]\nsource = "sim://demo/base?rate=3.3"\n')
    assert check(file) == EXIT_USAGE
    error = capsys.readouterr().err
    assert f"{file}:2: [ingest.a] source: demo/bow: scenario 'demo' has no stream 'bow'; there are rover" in error
    assert f"{file}:4: [ingest.b] source: demo/base: rate 3.3 Hz" in error
    file.write_text('[ingest.a]\nsource = "tcp://localhost:5015"\n[ingest.b]\nsource = "sim://demo/base"\n')
    assert check(file) == 0
    assert "right; 4 processes: hub, control, a, b" in capsys.readouterr().out


def test_keys_and_schemas_are_printed(capsys: pytest.CaptureFixture[str]):
    """The reference is at hand without the documentation."""
    assert keys() == 0
    assert "rtk/{id}/sol" in capsys.readouterr().out
    assert keys(as_json=True) == 0
    assert {"name": "cmd"}.items() <= json.loads(capsys.readouterr().out)[0].items()
    assert schema("Reply") == 0
    assert json.loads(capsys.readouterr().out)["x-rtkmesh"]["encoding"] == "application/msgpack;rtkmesh.Reply/1"
    assert schema("Repli") == EXIT_USAGE
    assert "did you mean 'Reply'" in capsys.readouterr().err


def test_status_tells_also_the_processes_that_failed(capsys: pytest.CaptureFixture[str]):
    """A process that is not there cannot answer: control's word stands for it, and the exit code says it."""
    rows = [
        {"id": "control", "role": "control", "state": "RUNNING", "reason": ""},
        {"id": "rtk", "role": "solver", "state": "FAILED", "reason": "exit code 2: no such satellite"},
    ]
    data = {"id": "control", "role": "control", "state": "DEGRADED", "start_id": "a", "heartbeat": 1, "data": {"processes": rows}}
    replies = [Reply(ok=True, code=Code.OK, id="control", data=data)]
    assert unanswering(replies) == rows[1:]
    assert status_exit_code(replies) == EXIT_FAILED
    show_status(replies)
    assert "exit code 2: no such satellite" in capsys.readouterr().out


def test_status_tells_the_integrity_of_the_newest_solution(capsys: pytest.CaptureFixture[str]):
    """What a solver says of its solution stands where it has nothing else to say."""
    for integrity, why, expected in (("ok", "ok", "FIX, integrity ok"), ("failed", "codes", "FIX, integrity failed (codes)")):
        words = {"solution": "FIX", "integrity": integrity, "integrity_reason": why}
        data = {"id": "rtk", "role": "solver", "state": "RUNNING", "start_id": "a", "heartbeat": 1, "data": words}
        show_status([Reply(ok=True, code=Code.OK, id="rtk", data=data)])
        assert expected in capsys.readouterr().out


@pytest.mark.e2e
def test_the_commands_of_daily_use(site: Any):
    """status, cmd and echo on a running network: text, JSON, exit codes."""
    where = ("--connect", site.endpoint)
    site.process("p")
    with site.bus() as bus:
        site.is_running(bus, "p")
        site.until(lambda: set(bus.live()) == {"hub", "p"})
    status = rtkmesh("status", *where)
    assert status.returncode == 0, status.stderr
    lines = [line.split()[:3] for line in status.stdout.splitlines()]
    assert lines == [["id", "role", "state"], ["hub", "hub", "RUNNING"], ["p", "solver", "RUNNING"]]
    rows = json.loads(rtkmesh("status", "--json", *where).stdout)
    assert [row["id"] for row in rows] == ["hub", "p"]
    one = rtkmesh("cmd", "p", "help", "--json", *where)
    assert "crash" in json.loads(one.stdout)["data"]["operations"]
    all_ = rtkmesh("cmd", "*", "status", "--json", *where)
    assert [reply["id"] for reply in json.loads(all_.stdout)] == ["hub", "p"]
    unknown = rtkmesh("cmd", "p", "crsh", *where)
    assert (unknown.returncode, "did you mean 'crash'" in unknown.stderr) == (2, True)
    absent = rtkmesh("cmd", "q", "status", "--timeout", "2", *where)
    assert (absent.returncode, "absent" in absent.stderr) == (3, True)
    echo = rtkmesh("echo", "*/status", "-n", "2", "--json", *where)
    assert {json.loads(line)["value"]["role"] for line in echo.stdout.splitlines()} == {"hub", "solver"}
    nothing = rtkmesh("echo", "p/sol", "--timeout", "2", *where)
    assert (nothing.returncode, nothing.stdout) == (124, "")


@pytest.mark.e2e
@pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="without JIT there is nothing to compile")
def test_warm_compiles_or_loads_the_kernels():
    """After it all kernels that a deployment uses are in the cache: the second time nothing is compiled."""
    first = rtkmesh("warm")
    assert "mode kinematic" in first.stderr
    second = json.loads(rtkmesh("warm", "--json").stdout)
    assert second["compiled"] == 0
    assert second["loaded"] > 15


@pytest.mark.e2e
def test_an_absent_network_is_said_with_its_exit_code(fleet: Any):
    """No hub: exit code 3, one line, no traceback."""
    result = rtkmesh("status", "--connect", fleet.endpoint)
    assert (result.returncode, result.stdout) == (3, "")
    assert result.stderr.startswith("rtkmesh: no hub at tcp/127.0.0.1:")
    assert result.stderr.count("\n") == 1


@pytest.mark.e2e
def test_run_says_what_is_wrong_with_the_file(fleet: Any):
    """A typo, an unknown id, no id: one line and exit code 2."""
    config = fleet.config
    config.write_text('[ingest.rover]\nsourc = "x"\n')
    broken = rtkmesh("run", "ingest", "--id", "rover", "--config", str(config))
    assert (broken.returncode, f"{config}:2: [ingest.rover] unknown key 'sourc'; did you mean 'source'?" in broken.stderr) == (2, True)
    config.write_text('[ingest.rover]\nsource = "tcp://localhost:1"\n')
    wrong = rtkmesh("run", "ingest", "--id", "rovr", "--config", str(config))
    assert (wrong.returncode, "did you mean 'rover'" in wrong.stderr) == (2, True)
    missing = rtkmesh("run", "ingest", "--config", str(config))
    assert (missing.returncode, "--id" in missing.stderr) == (2, True)


@pytest.mark.e2e
def test_reads_are_quick_and_light():
    """The help of every command, without numpy or the engine in the process."""
    script = (
        "import sys; from rtkmesh_services.cli import cmd, status, echo, check, run; "
        "sys.exit(any(name in sys.modules for name in ('numpy', 'numba', 'zenoh')))"
    )
    assert subprocess.run([sys.executable, "-c", script], check=False, timeout=60).returncode == 0
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert rtkmesh("cmd", "--help").returncode == 0
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < 1.0
    assert {"run", "cmd", "status", "echo", "check", "warm", "keys", "schema"} <= set(COMMANDS)


def test_the_farewell_of_up_has_a_part_for_each_thing_it_knows(capsys: pytest.CaptureFixture[str]) -> None:
    """Without solutions it ends after the restarts."""
    file = config_path("demo.toml")
    foreground = Foreground(load_site(file, None, ""), LaunchOptions(file), reason="it is enough", seconds=1.25)
    foreground.report()
    assert capsys.readouterr().err == "ended after 1.2 s (it is enough); 0 restarts\n"


def test_a_screen_is_shown_as_rtkrcv_does_and_other_answers_with_their_data() -> None:
    said: list[str] = []
    reply = Reply(ok=True, code=Code.OK, message="1 satellites", data={"satellite": ["G01"]}, id="rtk", text="SAT C1\nG01 OK\x07\n")
    show_reply(reply, said.append, as_screen=True)
    show_reply(reply, said.append)
    assert said == ["rtk: 1 satellites\nSAT C1\nG01 OK\ufffd\n", "rtk: 1 satellites\n  satellite:\n    G01\n"]
