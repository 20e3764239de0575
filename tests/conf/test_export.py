"""What is exported is what RTKLIB understands: its own programs read it and say what they have read."""

import os
import pty
import re
import socket
import subprocess
import tomllib
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest

from rtkmesh_schemas.config import Deployment
from rtkmesh_schemas.config_base import Table
from rtkmesh_services.cli.main import run
from rtkmesh_services.conf.choices import DIALECTS, Dialect
from rtkmesh_services.conf.conf_file import parse_conf
from rtkmesh_services.conf.exporter import export_conf
from rtkmesh_services.conf.importer import import_conf
from rtkmesh_services.conf.solver_setters import ENGINE_DEFAULTS, effective
from rtkmesh_services.conf.table import ALL_ROWS

Conf = Callable[..., bytes]
_MEANT = re.compile(r"^([a-z0-9]+-[A-Za-z0-9_]+) *=([^#\n]*)", re.MULTILINE)


def pairs(text: str) -> dict[str, str]:
    """Return the keys and values of a .conf file."""
    return {key: value.strip() for key, value in _MEANT.findall(text)}


def deployment_of(data: bytes) -> Deployment:
    return msgspec.convert(import_conf(parse_conf(data, "a.conf")).tables, Deployment)


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_round_trip_changes_nothing(rtkrcv: Conf, dialect: Dialect):
    """conf -> deployment -> conf -> deployment: what RTKLIB has a word for comes back the same (minfixsats is demo5's alone)."""
    first = deployment_of(rtkrcv())
    again = deployment_of(export_conf(first, "rtk", dialect, "a.toml").encode())
    ours, theirs = first.solver["rtk"], again.solver["rtk"]
    for path in (*ENGINE_DEFAULTS, *(name for name in ours.__struct_fields__ if not isinstance(getattr(ours, name), Table))):
        if (path, dialect) != ("ambiguity.minimum_ambiguities", "2.4"):
            assert effective(theirs, path) == pytest.approx(effective(ours, path)), path
    assert theirs.sync == ours.sync
    assert again.ingest["rover"] == first.ingest["rover"] or dialect == "2.4"  # receivers' options are demo5's
    assert again.ingest["corrections"].source.partition("?")[0] == first.ingest["corrections"].source.partition("?")[0]
    texts = msgspec.structs.replace(again.output["solution2"], dialect="demo5", single=True, max_sigma_m=2.0)
    assert texts == first.output["solution2"]
    assert again.output["state_log"] == first.output["state_log"]


def rtkrcv_says(program: str, conf: Path, folder: Path, port: int) -> dict[str, str]:
    """Return the options that rtkrcv has read from a file, as it saves them."""
    saved = folder / "saved.conf"
    master, slave = pty.openpty()
    process = subprocess.Popen([program, "-p", str(port), "-w", "", "-o", str(conf)], stdin=slave, stdout=slave, stderr=slave, cwd=folder)
    try:
        with connected(port) as console:
            heard(console, b"rtkrcv> ")
            console.sendall(f"save {saved}\r\n".encode())
            heard(console, b"options saved to")
    finally:
        process.kill()
        process.wait()
        os.close(master)
        os.close(slave)
    return pairs(saved.read_text())


def connected(port: int) -> socket.socket:
    """Return a connection as soon as somebody listens."""
    for _ in range(2000):
        probe = socket.socket()
        if probe.connect_ex(("127.0.0.1", port)) == 0:
            probe.settimeout(10.0)
            return probe
        probe.close()
    raise AssertionError("rtkrcv does not listen")


def heard(console: socket.socket, words: bytes) -> None:
    received = b""
    while words not in received:
        part = console.recv(65536)
        assert part, received
        received += part


def same(key: str, ours: str, theirs: str, dialect: Dialect) -> bool:
    """Return whether two values mean the same: numbers as numbers, choices by any of their names."""
    row = ALL_ROWS[key]
    if row.choices is not None and dialect == "2.4":
        aliases = row.choices.aliases
        numbers = {**row.choices.old, **{name: row.choices.old[full] for name, full in aliases.items()}}
        return str(numbers.get(ours, ours)) == str(numbers.get(theirs, theirs))
    try:
        return float(ours or 0) == pytest.approx(float(theirs or 0), rel=1e-6)
    except ValueError:
        return ours == theirs


@pytest.mark.rtklib
def test_rtkrcv_understands_the_export(rtkrcv: Conf, rtklib_program: Callable[[str], str], tmp_path: Path, free_port: Callable[[], int]):
    """2.4.3 b34 saves what it has read: every key that it knows has our value."""
    text = export_conf(deployment_of(rtkrcv()), "rtk", "2.4", "a.toml")
    (tmp_path / "a.conf").write_text(text)
    understood = rtkrcv_says(rtklib_program("rtkrcv"), tmp_path / "a.conf", tmp_path, free_port())
    told = pairs(text)
    assert len(understood) > 150
    wrong = {key: (told[key], value) for key, value in understood.items() if key in told and not same(key, told[key], value, "2.4")}
    assert wrong == {}
    assert set(understood) <= set(told)


def test_demo5_understands_the_export(rtkrcv: Conf, tmp_path: Path):
    """demo5's own loader (pyrtklib5) saves what it has read: every system key has our value."""
    rtklib = pytest.importorskip("pyrtklib5")
    text = export_conf(deployment_of(rtkrcv()), "rtk", "demo5", "a.toml")
    conf, saved = tmp_path / "a.conf", tmp_path / "saved.conf"
    conf.write_text(text)
    rtklib.resetsysopts()
    assert rtklib.loadopts(str(conf), rtklib.sysopts.ptr) == 1
    process, solution, files = rtklib.prcopt_t(), rtklib.solopt_t(), rtklib.filopt_t()
    rtklib.getsysopts(process, solution, files)
    assert process.mode == rtklib.PMODE_MOVEB
    assert process.elmin == pytest.approx(0.2181661565)
    assert process.nf == 3
    assert process.navsys == 45
    assert process.thresar[0] == 2.5
    assert process.baseline[0] == 1.05
    assert rtklib.saveopts(str(saved), "w", "", rtklib.sysopts.ptr) == 1
    told, understood = pairs(text), pairs(saved.read_text())
    masks = {f"pos1-snrmask_L{band}" for band in "1256"}
    wrong = {key: (told[key], value) for key, value in understood.items() if key not in masks and not same(key, told[key], value, "demo5")}
    assert wrong == {}
    assert len(understood) > 120


def test_what_rtklib_has_no_word_for_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """In comments at the top; references to the environment stay references."""
    file = tmp_path / "a.toml"
    file.write_text(
        '[ingest.rover]\nsource = "udp://0.0.0.0:5000"\nfallback = ["tcp://a:1"]\n'
        '[ingest.base]\nsource = "ntrips://me:${NO_SUCH_PASSWORD}@c.example/M"\nposition_llh_deg = [47.5, 8.5, 500.25]\n'
        '[solver.rtk]\nrover = "rover"\nbase = "base"\nsync = { max_wait_s = 2.0 }\nmode = "static-start"\n'
        '[output.a]\ntarget = "file://a.json"\nsolver = "rtk"\nformat = "json"\n'
    )
    assert run(["conf", "export", str(file), "--dialect", "2.4"]) == 0
    text = capsys.readouterr().out
    lost = [line for line in text.splitlines() if line.startswith("# not said")]
    for words in ("no input such as udp://", "one source per input", "no TLS", "max_wait_s = 2", "no format json"):
        assert any(words in line for line in lost), words
    told = pairs(text)
    assert told["inpstr2-path"] == "me:${NO_SUCH_PASSWORD}@c.example:443/M"
    assert (told["ant2-postype"], told["ant2-pos1"], told["ant2-pos3"]) == ("llh", "47.5", "500.2500")
    assert "static-start is not in 2.4" in text
    assert tomllib.loads(file.read_text())["solver"]["rtk"]["mode"] == "static-start"


def test_a_solver_is_chosen(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Of several one is to be named."""
    file = tmp_path / "a.toml"
    file.write_text(
        '[ingest.r]\nsource = "tcp://a:1"\n[solver.one]\nrover = "r"\nmode = "single"\n[solver.two]\nrover = "r"\nmode = "single"\n'
    )
    assert run(["conf", "export", str(file)]) == 2
    assert "has 2 solvers (one, two): say --solver ID" in capsys.readouterr().err
    assert run(["conf", "export", str(file), "--solver", "two", "--out", str(tmp_path / "two.conf")]) == 0
    assert pairs((tmp_path / "two.conf").read_text())["pos1-posmode"] == "single"
