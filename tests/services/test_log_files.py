"""Log files of processes that nobody reads: bounded, whole, and followed by `rtkmesh logs`."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from rtkmesh_schemas.keys import Role
from rtkmesh_services.cli.log_lines import Follower, Wanted, newest
from rtkmesh_services.control.fleet import ProcessSpec
from rtkmesh_services.control.output import ProcessLog
from rtkmesh_services.control.process import start_program
from rtkmesh_services.runtime.log_files import VARIABLE, append, older, open_log, tail

FULL = 4000
# Writes log records, and with every tenth what a library would write by itself.
WRITES = f"""
import logging, os, sys
from rtkmesh_services.runtime.log_files import bound_own_output
from rtkmesh_services.runtime.logs import configure
log = configure("rover", "ingest", "info")
bound_own_output({FULL})
for number in range(int(sys.argv[1])):
    log.info("line %d", number)
    if number % 10 == 0:
        os.write(2, b"a library says %d\\n" % number)
"""


def write(file: Path, count: int) -> None:
    """Let a real process write so many lines into a log file."""
    argv = (sys.executable, "-c", WRITES, str(count))
    spec = ProcessSpec("rover", Role.INGEST, argv, {**os.environ, VARIABLE: str(file)}, log_file=file)
    assert start_program(spec).wait() == 0


def test_a_log_is_bounded_and_its_end_is_whole(tmp_path: Path) -> None:
    """However much is written: two files, each about as large as said, the newest lines in their order without a gap."""
    file = tmp_path / "rover.log"
    write(file, 300)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["rover.log", "rover.log.1"]
    assert file.stat().st_size + older(file).stat().st_size < 2 * (FULL + 300)
    rows = (older(file).read_bytes() + file.read_bytes()).splitlines()
    numbers = [int(json.loads(row)["text"].split()[1]) for row in rows if row.startswith(b"{")]
    assert numbers == list(range(numbers[0], 300))
    assert numbers[0] < 290
    assert b"a library says 290" in rows
    assert file.stat().st_mode & 0o077 == 0, "for its owner alone"


def test_a_log_that_was_taken_away_is_begun_anew(tmp_path: Path) -> None:
    """As by a cleaning of the folder: then the old file would grow where nobody sees it."""
    file = tmp_path / "deep" / "rover.log"
    script = WRITES.replace("for number", "import pathlib; pathlib.Path(os.environ['RTKMESH_LOG_FILE']).unlink()\nfor number")
    spec = ProcessSpec("rover", Role.INGEST, (sys.executable, "-c", script, "100"), {**os.environ, VARIABLE: str(file)}, log_file=file)
    assert start_program(spec).wait() == 0
    assert tail(file, 1)
    assert file.stat().st_size < FULL + 300


def test_tail_looks_into_the_older_file_and_no_further_than_asked(tmp_path: Path) -> None:
    file = tmp_path / "a.log"
    older(file).write_bytes(b"one\ntwo\n")
    file.write_bytes(b"three\nfour")
    assert tail(file, 10) == [b"one", b"two", b"three", b"four"]
    assert tail(file, 2) == [b"three", b"four"]
    assert tail(file, 10, 15) == [b"two", b"three", b"four"]
    assert tail(file, 0) == []
    assert tail(tmp_path / "none.log", 5) == []


def test_the_cause_of_a_death_is_of_the_last_process(tmp_path: Path) -> None:
    """What one wrote before does not count for the next."""
    spec = ProcessSpec("rover", Role.INGEST, (), log_file=tmp_path / "rover.log")
    log = ProcessLog(spec)
    log.begins()
    append(tmp_path / "rover.log", b"ZeroDivisionError: x")
    assert log.last_error() == "ZeroDivisionError: x"
    log.begins()
    assert log.last_error() == ""
    append(tmp_path / "rover.log", b'{"level": "error", "text": "no such port", "time": "2026-01-01T00:00:00.000"}')
    append(tmp_path / "rover.log", b'{"level": "info", "text": "STOPPED", "time": "2026-01-01T00:00:00.001"}')
    assert log.last_error() == "no such port"
    assert log.last(2) == ["error: no such port", "info: STOPPED"]


def record(level: str, text: str, second: int) -> bytes:
    return json.dumps({"level": level, "text": text, "time": f"2026-01-01T00:00:{second:02d}.000"}).encode()


def test_a_follower_goes_on_in_the_new_file_and_loses_nothing(tmp_path: Path) -> None:
    file = tmp_path / "rover.log"
    append(older(file), record("info", "oldest", 0))
    append(file, record("info", "old", 1))
    follower = Follower("rover", file)
    assert [line.text for line in follower.begin()] == ["oldest", "old"]
    append(file, record("info", "new", 2))
    descriptor = open_log(file)
    os.write(descriptor, b"half a ")
    assert [line.text for line in follower.read()] == ["new"]
    os.write(descriptor, b"line\n")
    os.close(descriptor)
    file.replace(older(file))
    append(file, record("info", "newest", 3))
    lines = follower.read()
    assert [line.text for line in lines] == ["half a line", "newest"]
    assert lines[0].time == "2026-01-01T00:00:02.000", "that of the line before"
    assert follower.read() == []


def test_levels_and_counts(tmp_path: Path) -> None:
    file = tmp_path / "rover.log"
    for number, level in enumerate(("debug", "info", "warning", "error")):
        append(file, record(level, level, number))
    append(file, b"Traceback")
    lines = Follower("rover", file).begin()
    assert [line.text for line in newest(lines, 9, Wanted("warning"))] == ["warning", "error", "Traceback"]
    assert [line.text for line in newest(lines, 2, Wanted())] == ["error", "Traceback"]
    assert newest(lines, 0, Wanted()) == []


def test_a_full_disk_stops_no_process(tmp_path: Path) -> None:
    """/dev/full refuses every byte: the process runs to its end."""
    spec = ProcessSpec("rover", Role.INGEST, (sys.executable, "-c", WRITES.partition("    if number")[0], "20"))
    with Path("/dev/full").open("wb") as full:
        run = subprocess.run(spec.argv, env={**os.environ, VARIABLE: str(tmp_path / "x.log")}, stderr=full, stdout=full, check=False)
    assert run.returncode == 0


@pytest.mark.parametrize("raw", [b"\xff\xfe{", b'{"text": 3}', b'{"text": "a\\u001b[2J"}', b"[" * 5000, b""])
def test_any_bytes_in_a_log_are_lines_for_a_terminal(tmp_path: Path, raw: bytes) -> None:
    file = tmp_path / "rover.log"
    append(file, raw)
    for line in Follower("rover", file).begin():
        assert line.text.isprintable()
