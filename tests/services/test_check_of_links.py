"""`rtkmesh check` on sources, outputs and commands: one clear fault each with file, line and key, and never a password."""

from pathlib import Path

import pytest

from rtkmesh_services.cli.check import check

SECRET = "s3cr@t/?#x"
SHIPPED = sorted((Path(__file__).resolve().parents[2] / "config").glob("*.toml"))
REST = '\n[ingest.rover]\nsource = "udp://:7001"\n[solver.rtk]\nrover = "rover"\nbase = "base"\n'
SOURCE = '[ingest.base]\nsource = "{}"\n'
OUTPUT = '[ingest.base]\nsource = "udp://:7000"\n[output.out]\ntarget = "{}"\n'
# text -> (line, what is said)
FAULTS = {
    SOURCE.format("ntripp://u:${PW}@host/M"): (2, "unknown source 'ntripp'; did you mean 'ntrip'?"),
    SOURCE.format("ntrip://u:${PW}@host"): (2, "says no mount point; `rtkmesh ntrip list host` shows them, ?nearest chooses one"),
    SOURCE.format("ntrip://u:${PW}@host:70000/M"): (2, "the port is none from 1 to 65535"),
    SOURCE.format("ntrip://u:${PW}@host/M?versoin=1"): (2, "unknown option 'versoin'; did you mean 'version'?"),
    SOURCE.format("ntrip://u:${PW}@host/M?version=3"): (2, "version='3': allowed are auto, 1, 2"),
    SOURCE.format("ntrip://u:${PW}@host/M?gga=yes"): (2, "gga='yes': allowed are auto, on, off"),
    SOURCE.format("ntrip://u:${PW}@host/M?position=91,0"): (2, "position='91,0' is no LAT,LON"),
    SOURCE.format("ntrip://u:${PW}@host/M?ca=x.pem"): (2, "unknown option 'ca'"),
    SOURCE.format("ntrips://u:${PW}@host/M?ca=/no/such.pem"): (2, "ca='/no/such.pem': no such file"),
    SOURCE.format("ntrip://u:${NOT_THERE}@host/M"): (2, "the environment has no NOT_THERE"),
    SOURCE.format("ntrip://u:${PW}@host?nearest") + "position_llh_deg = [1.0, 2.0, 3.0]\n": (3, "is of one antenna, and ?nearest chooses"),
    SOURCE.format("udp://:7000") + 'fallback = ["ntrip://u:${PW}@h/M", "file://x.ubx"]\n': (
        3,
        "[1]: a recording neither has a fallback nor is",
    ),
    SOURCE.format("udp://:7000") + 'fallback = ["ntrp://u:${PW}@h/M"]\n': (3, "did you mean 'ntrip'?"),
    SOURCE.format("serial://ttyACM0"): (2, "names no port: /dev/NAME, by-id/NAME, VID:PID"),
    SOURCE.format("serial:///dev/ttyACM0?baud=fast"): (2, "baud='fast' is no number from 0 on, nor auto"),
    SOURCE.format("serial:///dev/ttyACM0") + '[ingest.base.commands]\nstart = ["!UBX CFG-RAT 1"]\n': (3, "CFG-RAT: no UBX message"),
    SOURCE.format("serial:///dev/ttyACM0") + '[ingest.base.commands]\nfile = "no.cmd"\n': (3, "no.cmd: No such file"),
    SOURCE.format("serial:///dev/ttyACM0") + '[ingest.base.commands]\nstrat = ["x"]\n': (4, "unknown key 'strat'; did you mean 'start'?"),
    SOURCE.format("udp://:7000") + '[ingest.base.commands]\nstart = ["x"]\n': (3, "commands go to a receiver"),
    SOURCE.format("file://{there}?times=yes"): (2, "neither a .tag nor a .times beside it"),
    SOURCE.format("file://{there}::S=1"): (2, "::S=1 means nothing here; ::T, ::+SECONDS and ::xSPEED do"),
    OUTPUT.format("ntrip://u:${PW}@host/M"): (3, "says nothing where it needs solver or receiver"),
    OUTPUT.format("zenoh://") + 'receiver = "base"\n': (4, "a receiver's frames are on the network already"),
    OUTPUT.format("ntrip://u:${PW}@host") + 'receiver = "base"\n': (4, "says no mount point to feed"),
    OUTPUT.format("ntrip://u:${PW}@host/M") + 'receiver = "bas"\n': (5, "no [ingest.bas]; did you mean 'base'?"),
    OUTPUT.format("ntrip://u:${PW}@host/M") + 'receiver = "base"\nprotocol = "rtcm"\n': (6, "did you mean 'rtcm3'?"),
    OUTPUT.format("ntrip-caster://127.0.0.1") + 'receiver = "base"\n': (3, "has 'receiver' where it needs mounts"),
    OUTPUT.format("ntrip-caster://127.0.0.1") + 'mounts = { "A B" = "base" }\n': (5, "'A B' is no mount point"),
    OUTPUT.format("ntrip-caster://127.0.0.1") + 'mounts = { AB = "bse" }\n': (5, "no [ingest.bse]; did you mean 'base'?"),
    OUTPUT.format("ntrip-caster://0.0.0.0:2101") + 'mounts = { AB = "base" }\n': (
        4,
        "everybody could read: say users, or anonymous",
    ),
    OUTPUT.format("file://x.log?swap=often") + 'receiver = "base"\n': (4, "swap='often' is no number of hours"),
}


@pytest.mark.parametrize("text", FAULTS, ids=[says[:40] for _, says in FAULTS.values()])
def test_each_fault_is_one_line_with_its_place(
    text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    line, says = FAULTS[text]
    monkeypatch.setenv("PW", SECRET)
    there = tmp_path / "there.ubx"
    there.touch()
    file = tmp_path / "robot.toml"
    file.write_text(text.replace("{there}", str(there)) + REST)
    assert check(file) == 2
    written = capsys.readouterr().err
    assert written.count("\n") == 1, written
    assert written.startswith(f"{file}:{line}: "), written
    assert says in written
    assert SECRET not in written
    assert "s3cr" not in written


@pytest.mark.parametrize("file", [file for file in SHIPPED if "{data}" not in file.read_text()], ids=lambda file: file.name)
def test_shipped_deployments_are_right(file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("NTRIP_PASSWORD", "ROVER_PASSWORD"):
        monkeypatch.setenv(name, SECRET)
    assert check(file) == 0, capsys.readouterr().err
