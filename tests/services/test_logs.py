"""What is written about a process holds no secrets and no control characters."""

import io
import json
import logging

import pytest

from rtkmesh_schemas.keys import LOG
from rtkmesh_schemas.status import LogRecord
from rtkmesh_schemas.wire import decode
from rtkmesh_services.runtime.logs import BusHandler, clean, configure, masked
from rtkmesh_services.runtime.memory_bus import MemoryBus


@pytest.fixture(autouse=True)
def _logging_as_it_was():
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    yield
    root.handlers[:] = handlers
    root.setLevel(level)


@pytest.mark.parametrize(
    "text",
    [
        "ntrip://user:hunter2@caster:2101/MOUNT",
        "cannot open ntrips://u.s-er:hunter2@[::1]:2101/M and more",
        "ntrip://us%40er:hun%20ter2hunter2@h/",
        "tcp://h:1?password=hunter2&x=1",
        "token=hunter2;",
        "ntrip://user:p:hunter2@h/M",
        "ntrip://user:hunter2/x@h/M",
    ],
)
def test_secrets_are_masked(text: str):
    """No form of a URL with a password shows it."""
    assert "hunter2" not in clean(text)
    assert "***" in clean(text)


@pytest.mark.parametrize("text", ["tcp://host:2101/x", "a:b@c", "rover epoch 12:30:01 @ 5 Hz", "http://h/?a=b"])
def test_harmless_text_is_kept(text: str):
    """Masking does not eat ordinary text."""
    assert clean(text) == text


def test_control_characters_are_stripped_and_length_is_bounded():
    """A receiver's text cannot write to the terminal or fill the disk with a line."""
    assert clean("a\x1b[31mb\x9b\r\x07c\n") == "a�[31mb���c\n"
    assert len(clean("x" * 10_000)) == 4000


def test_masked_goes_through_tables():
    """A configuration is shown without its secrets."""
    assert masked({"source": "ntrip://u:p@h/M", "list": ["x://u:p@h"], "n": 1}) == {
        "source": "ntrip://u:***@h/M",
        "list": ["x://u:***@h"],
        "n": 1,
    }


def test_json_lines_off_a_terminal():
    """One line a record, with id, role, fields, and the traceback in the text."""
    out = io.StringIO()
    log = configure("rover", "ingest", "info", out)
    log.debug("not shown")
    try:
        raise ValueError("ntrip://u:hunter2@h")
    except ValueError:
        log.exception("it failed: %s", "ntrip://u:hunter2@h", extra={"fields": {"url": "x://u:hunter2@h", "n": 3}})
    [line] = out.getvalue().splitlines()
    record = json.loads(line)
    assert (record["id"], record["role"], record["level"]) == ("rover", "ingest", "error")
    assert record["fields"]["n"] == 3
    assert "ValueError" in record["text"]
    assert "hunter2" not in line


def test_records_are_published_while_somebody_listens():
    """rtk/{id}/log has what is said, INFO and above, and only when it is read."""
    configure("rover", "ingest", "debug", io.StringIO())
    bus = MemoryBus("rover")
    logging.getLogger().addHandler(BusHandler(bus, "ingest"))
    log = logging.getLogger("rtkmesh")
    log.info("nobody listens")
    bus.subscribe("rtk/*/log", list[object]().append)
    log.debug("too quiet")
    log.warning("seen", extra={"fields": {"a": [1]}})
    [sample] = bus.sent(LOG)
    record = decode(LogRecord, sample.payload, sample.encoding)
    assert (record.text, record.level, record.fields) == ("seen", "warning", {"a": "[1]"})
