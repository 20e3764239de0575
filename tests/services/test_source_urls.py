"""Source URLs say what they mean and what is wrong with them."""

import pytest

from rtkmesh_services.errors import SourceError
from rtkmesh_services.ingest.urls import parse_source


def test_the_parts_of_each_scheme() -> None:
    serial = parse_source("serial:///dev/ttyACM0?baud=460800")
    assert (serial.path, serial.number("baud", 0)) == ("/dev/ttyACM0", 460800.0)
    tcp = parse_source("tcp://127.0.0.1:7001?timeout=3")
    assert (tcp.host, tcp.port, tcp.number("timeout", 10.0)) == ("127.0.0.1", 7001, 3.0)
    log = parse_source("file:///data/a log.ubx?speed=10")
    assert (log.path, log.speed) == ("/data/a log.ubx", 10.0)
    assert parse_source("file://log.ubx?speed=max").speed == 0.0
    assert parse_source("file://log.ubx").speed == 1.0
    assert parse_source("sim://demo/rover?rate=10").path == "demo/rover"


@pytest.mark.parametrize(
    ("url", "says"),
    [
        ("seriall:///dev/tty", "did you mean 'serial'"),
        ("/dev/ttyACM0", "unknown source"),
        ("tcp://host", "host:port"),
        ("tcp://host:99999", "host:port"),
        ("serial:///dev/tty?bau=9600", "did you mean 'baud'"),
        ("file://", "needs a path"),
    ],
)
def test_what_is_wrong_is_named(url: str, says: str) -> None:
    with pytest.raises(SourceError, match=says):
        parse_source(url)


@pytest.mark.parametrize("speed", ["0", "-1", "fast", "nan"])
def test_a_wrong_speed_is_refused(speed: str) -> None:
    with pytest.raises(SourceError, match="speed"):
        _ = parse_source(f"file://x?speed={speed}").speed
