"""Recipes: every one that is shipped is told to a receiver behind a pseudo-terminal, and read back; what goes wrong is named."""

import json
from pathlib import Path
from typing import Any

import pytest
from pyubx2 import UBX_CONFIG_DATABASE
from serial.tools.list_ports_common import ListPortInfo
from tests.services.simulated_receiver import SimulatedReceiver, running
from tests.services.simulated_text_receivers import SimulatedMosaic, SimulatedUnicore, TextReceiver

from rtkmesh_services.cli.main import run
from rtkmesh_services.errors import SourceError
from rtkmesh_services.ingest.receivers import configure as configuring
from rtkmesh_services.ingest.receivers import orders
from rtkmesh_services.ingest.receivers import probe as probing
from rtkmesh_services.ingest.receivers.orders import Conversation
from rtkmesh_services.ingest.receivers.probe import ports, probe
from rtkmesh_services.ingest.receivers.recipes import for_port, load_recipe, port_of, shipped_recipes

RECIPES = list(shipped_recipes())


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """These receivers answer at once."""
    monkeypatch.setattr(configuring, "QUIET_S", 0.15)
    monkeypatch.setattr(orders, "FIRST_PATIENCE_S", 0.4)


def receiver_for(recipe: str) -> SimulatedReceiver | TextReceiver:
    if recipe.startswith("um982"):
        return SimulatedUnicore()
    if recipe.startswith("mosaic"):
        return SimulatedMosaic()
    return SimulatedReceiver(model="M8T" if recipe == "m8t" else "ZED-F9P")


def configure(capsys: pytest.CaptureFixture[str], path: str, recipe: str, *more: str) -> tuple[int, Any]:
    code = run(["receiver", "configure", "--source", f"serial://{path}", "--recipe", recipe, "--json", *more])
    out = capsys.readouterr().out
    return code, json.loads(out) if out else None


def test_there_are_recipes_for_the_receivers_that_we_speak_to():
    assert {"f9p_rover", "f9p_base", "f9p_moving_base", "m8t", "um982", "mosaic"} <= set(RECIPES)


@pytest.mark.parametrize("recipe", RECIPES)
def test_a_shipped_recipe_is_taken_and_read_back(recipe: str, capsys: pytest.CaptureFixture[str]):
    with running(receiver_for(recipe)) as receiver:
        code, outcome = configure(capsys, receiver.path, recipe, "--save")
    wrong = [row for row in outcome["rows"] if row["ok"] is False or row["answer"] not in ("taken", "")]
    assert wrong == []
    assert (code, outcome["ok"], outcome["saved"]) == (0, True, True)
    assert sum(row["ok"] is True for row in outcome["rows"]) >= 2
    assert any(name in outcome["identity"] for name in ("ZED-F9P", "M8T", "UM982", "mosaic-X5"))


def test_keys_are_in_the_receiver_and_in_its_flash_only_when_it_is_to_save_them(capsys: pytest.CaptureFixture[str]):
    with running(SimulatedReceiver()) as receiver:
        assert configure(capsys, receiver.path, "f9p_rover")[0] == 0
        assert (receiver.value("CFG_RATE_MEAS"), receiver.value("CFG_MSGOUT_UBX_RXM_RAWX_UART1")) == (200, 1)
        assert receiver.flash == {}
        assert configure(capsys, receiver.path, "f9p_rover", "--save", "--port", "USB")[0] == 0
        assert receiver.flash[UBX_CONFIG_DATABASE["CFG_MSGOUT_UBX_RXM_RAWX_USB"][0]] == 1


def test_a_key_that_the_receiver_does_not_have_is_named_and_the_others_are_set(capsys: pytest.CaptureFixture[str]):
    with running(SimulatedReceiver(refused=frozenset({"CFG_MSGOUT_UBX_RXM_RTCM_UART1"}))) as receiver:
        code, outcome = configure(capsys, receiver.path, "f9p_rover")
        wrong = [row["setting"] for row in outcome["rows"] if row["ok"] is False]
        assert (code, outcome["ok"], wrong) == (1, False, ["CFG-MSGOUT-UBX_RXM_RTCM_UART1"])
        assert receiver.value("CFG_MSGOUT_UBX_RXM_RAWX_UART1") == 1


def test_what_was_acknowledged_and_not_done_is_found_by_reading_back(capsys: pytest.CaptureFixture[str]):
    with running(SimulatedReceiver(stubborn=frozenset({"CFG_RATE_MEAS"}))) as receiver:
        code, outcome = configure(capsys, receiver.path, "f9p_rover")
    [row] = [row for row in outcome["rows"] if row["ok"] is False]
    assert (code, row["setting"], row["wanted"], row["answer"], row["read"]) == (1, "CFG-RATE-MEAS", "200", "taken", "0")


def test_lost_answers_are_asked_for_again(capsys: pytest.CaptureFixture[str]):
    with running(SimulatedReceiver(deaf=1)) as receiver:
        assert configure(capsys, receiver.path, "f9p_rover")[0] == 0


def test_another_model_is_told_nothing_unless_forced(capsys: pytest.CaptureFixture[str]):
    with running(SimulatedReceiver(model="NEO-M9N")) as receiver:
        code, outcome = configure(capsys, receiver.path, "f9p_base")
        assert (code, outcome["fits"], outcome["rows"]) == (4, False, [])
        assert receiver.ram == {}
        assert configure(capsys, receiver.path, "f9p_base", "--force")[0] == 0


def test_a_port_with_nobody_behind_it_or_that_is_in_use_is_named(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(orders, "FIRST_PATIENCE_S", 0.05)
    with running(SimulatedReceiver()) as receiver:
        assert run(["receiver", "configure", "--source", f"serial://{receiver.path}", "--recipe", "um982"]) == 3
        assert "nobody answers in the language of unicore receivers" in capsys.readouterr().err
    assert run(["receiver", "configure", "--source", "serial:///dev/no_such", "--recipe", "um982"]) == 3
    assert "no such device is plugged in" in capsys.readouterr().err


def test_a_text_receiver_that_refuses_is_named(capsys: pytest.CaptureFixture[str]):
    with running(SimulatedUnicore(refused=("OBSVHCMPB",))) as receiver:
        code, outcome = configure(capsys, receiver.path, "um982")
    wrong = [(row["setting"], row["answer"]) for row in outcome["rows"] if row["ok"] is False]
    assert code == 1
    assert wrong == [("OBSVHCMPB COM1 0.2", "PARSING FAILED NO MATCHING FUNC OBSVHCMPB COM1 0.2"), ("OBSVHCMPB COM1 0.2", "")]


def test_a_dry_run_opens_nothing_and_the_table_is_for_people(capsys: pytest.CaptureFixture[str]):
    assert run(["receiver", "configure", "--recipe", "f9p_base", "--port", "UART2", "--dry-run", "--save"]) == 0
    out = capsys.readouterr().out
    assert "CFG-MSGOUT-RTCM_3X_TYPE1077_UART2 = 1" in out
    assert "layers RAM, BBR, flash" in out
    assert run(["receiver", "recipes"]) == 0
    assert "f9p_moving_base" in capsys.readouterr().out
    with running(SimulatedReceiver()) as receiver:
        assert run(["receiver", "configure", "--source", f"serial://{receiver.path}", "--recipe", "f9p_rover"]) == 0
    out = capsys.readouterr().out
    assert "ZED-F9P" in out
    assert "CFG-RATE-MEAS" in out


def step(language: str, what: str) -> str:
    return f'title = "x"\nlanguage = "{language}"\n[[step]]\nwhat = "rate"\n{what}\n'


WRONG = {
    "no TOML": ("title =", "no TOML"),
    "an unknown word": ('title = "x"\nlanguage = "ublox"\nsteps = []\n', "steps"),
    "an unknown language": (step("ubox", "keys = { CFG-RATE-MEAS = 1 }"), "language"),
    "a wrong key": (step("ublox", "keys = { CFG-RATE-MES = 1 }"), "step 1 (rate): CFG-RATE-MES: there is no"),
    "a wrong message": (step("ublox-legacy", 'messages = ["CFG-RAT 1"]'), "CFG-RAT: no UBX message"),
    "a step of another language": (step("unicore", "keys = { CFG-RATE-MEAS = 1 }"), "has commands"),
    "nothing to do": (step("unicore", ""), "has commands"),
}


@pytest.mark.parametrize(("text", "says"), WRONG.values(), ids=list(WRONG))
def test_wrong_recipes_are_named(tmp_path: Path, text: str, says: str):
    file = tmp_path / "mine.toml"
    file.write_text(text)
    with pytest.raises(SourceError) as raised:
        load_recipe(str(file))
    assert str(raised.value).startswith(f"{file}: ")
    assert says in str(raised.value)


def test_recipes_are_named_nearly_and_ports_exactly(tmp_path: Path):
    with pytest.raises(SourceError, match="no recipe 'f9p_rver'; did you mean 'f9p_rover'"):
        load_recipe("f9p_rver")
    with pytest.raises(SourceError, match="'COM1' is no port of such a receiver: UART1"):
        load_recipe("f9p_rover", "COM1")
    with pytest.raises(SourceError, match="No such file"):
        load_recipe(str(tmp_path / "none.toml"))


def test_the_receivers_name_of_the_port_is_guessed():
    assert [port_of("ublox", device) for device in ("serial:///dev/ttyACM0", "serial:///dev/ttyUSB0")] == ["USB", "UART1"]
    assert for_port(load_recipe("um982", "COM2"), "COM2").step[0].commands == ("UNLOG COM2",)


def usb(device: str, vid: int, pid: int, serial_number: str = "") -> ListPortInfo:
    info = ListPortInfo(device)
    info.vid, info.pid, info.serial_number, info.product = vid, pid, serial_number, "a product"
    return info


def test_ports_are_named_so_that_they_are_found_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "usb-FTDI_x-if00").symlink_to("/dev/ttyUSB2")
    monkeypatch.setattr(probing, "BY_ID", tmp_path)
    there = [
        ListPortInfo("/dev/ttyS0"),
        usb("/dev/ttyACM0", 0x1546, 0x01A9),
        usb("/dev/ttyUSB0", 0x0403, 0x6015, "A"),
        usb("/dev/ttyUSB1", 0x0403, 0x6015, "B"),
        usb("/dev/ttyUSB2", 0x1A86, 0x7523),
        usb("/dev/ttyUSB3", 0x1A86, 0x7523),
    ]
    found = {port.device: port for port in ports(there)}
    assert [port.url for port in found.values()] == [
        "serial://1546:01a9",
        "serial:///dev/ttyS0",
        "serial://0403:6015:A",
        "serial://0403:6015:B",
        "serial://by-id/usb-FTDI_x-if00",
        "serial:///dev/ttyUSB3",
    ]
    assert found["/dev/ttyACM0"].looks_like == "u-blox F9 or later"


def test_who_is_behind_a_port_is_found_by_asking(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    with running(SimulatedReceiver()) as ublox, running(SimulatedUnicore()) as unicore:
        assert run(["ports", ublox.path, unicore.path, "--probe", "--json"]) == 0
        first, second = (row["probe"] for row in json.loads(capsys.readouterr().out))
        assert (first["state"], first["receiver"], first["sends"], "ZED-F9P" in first["version"]) == ("found", "ublox", ["u-blox"], True)
        assert (second["state"], second["receiver"], second["sends"], "UM982" in second["version"]) == ("found", "unicore", ["NMEA"], True)
        wire = probing.open_port(ublox.path, 115200)
        assert probe(ublox.path).state == "in use"
        wire.close()
    monkeypatch.setattr(probing, "BAUDS", (115200,))
    monkeypatch.setattr(probing, "ASKED_BAUDS", (115200,))
    with running(SimulatedReceiver(second_s=1e6)) as silent:
        found = probe(silent.path)
        assert (found.state, found.receiver, found.sends) == ("found", "ublox", ())


def test_generation_8_is_told_from_later_ones():
    said = ["ZED-F9P, EXT CORE 1.00 (f10c36), ROM BASE 0x118B2060, FWVER=HPG 1.32, PROTVER=27.31", "EXT CORE 3.01, PROTVER 20.30", "2.01"]
    assert [probing.ublox_language(text) for text in said] == ["ublox", "ublox-legacy", "ublox-legacy"]


def test_an_order_is_judged_by_lines_between_other_bytes():
    """A whole talk with a text receiver: what it sends by itself is in between."""
    from rtkmesh_services.ingest.receivers.text_receivers import unicore

    talk = Conversation([unicore("MODE ROVER")], lambda _: True)
    talk.tick(0.0)
    for line in ("$GNGGA,000000.00,,,,,0,00,99.9,,,,,,*4E", "$command,MODE,response: OK*5D", "$command,MODE ROVER,response: OK*00"):
        talk.hear(line, 0.1)
    assert (talk.ended, talk.failure) == (True, "")


def test_saved_positions_on_the_command_line(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("RTKMESH_STATE", str(tmp_path))
    assert run(["base", "list"]) == 1
    place = ["--llh", "47.397742,8.545594,488.0", "--accuracy", "0.01", "--datum", "ETRS89"]
    assert run(["base", "save", "roof", *place]) == 0
    assert run(["base", "save", "roof", *place]) == 4
    assert "say replace" in capsys.readouterr().err
    assert run(["base", "save", "roof", "--ecef", "4268987.1,1178894.4,4574798.7", "--replace"]) == 0
    assert run(["base", "save", "roof", "--ecef", "1,2,3"]) == 2
    assert run(["base", "save", "../roof", *place]) == 4
    capsys.readouterr()
    assert run(["base", "show", "roof", "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["current"]["position_ecef_m"] == [4268987.1, 1178894.4, 4574798.7]
    assert (shown["history"][0]["datum"], shown["history"][0]["accuracy_m"]) == ("ETRS89", 0.01)
    assert run(["base", "list"]) == 0
    assert "4574798" not in capsys.readouterr().out, "people read degrees"
    assert run(["base", "forget", "roof"]) == 0
    assert run(["base", "forget", "roof"]) == 1
    assert run(["base", "show", "nowhere"]) == 1
