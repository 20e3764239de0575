"""Links over real sockets and a real pseudo-terminal: they connect, come back, write, and say what is wrong."""

import os
import pty
import queue
import socket
import tty
from collections.abc import Iterator

import pytest
from tests.patience import PATIENCE_S

from rtkmesh_services.control.endpoints import free_port
from rtkmesh_services.ingest.links import Chunk, Link, LinkReport, LinkState
from rtkmesh_services.ingest.urls import parse_source


class Sink:
    """Collects what a link hands over; ``until`` waits for it."""

    def __init__(self) -> None:
        self.items: queue.Queue[Chunk | LinkReport] = queue.Queue()
        self.data = b""

    def __call__(self, item: Chunk | LinkReport) -> None:
        self.items.put(item)

    def until_data(self, expected: bytes) -> None:
        while not self.data.endswith(expected):
            item = self.items.get(timeout=PATIENCE_S)
            if isinstance(item, Chunk):
                self.data += item.data

    def until_state(self, state: LinkState) -> str:
        while True:
            item = self.items.get(timeout=PATIENCE_S)
            if isinstance(item, LinkReport) and item.state is state:
                return item.detail


@pytest.fixture
def links() -> Iterator[list[Link]]:
    started: list[Link] = []
    yield started
    for link in started:
        link.stop()


def start(links: list[Link], url: str) -> Sink:
    sink = Sink()
    links.append(Link(parse_source(url), sink))
    links[-1].start()
    return sink


def test_tcp_comes_back_after_each_of_many_drops(links: list[Link]) -> None:
    server = socket.create_server(("127.0.0.1", 0))
    server.settimeout(PATIENCE_S)
    sink = start(links, f"tcp://127.0.0.1:{server.getsockname()[1]}")
    for number in range(5):
        connection, _ = server.accept()
        connection.sendall(b"epoch %d\n" % number)
        sink.until_data(b"epoch %d\n" % number)
        connection.close()
    server.close()


def test_an_absent_server_is_named_and_waited_for(links: list[Link]) -> None:
    port = free_port()
    sink = start(links, f"tcp://127.0.0.1:{port}")
    assert "refused" in sink.until_state(LinkState.ERROR).lower()
    with socket.create_server(("127.0.0.1", port)) as server:
        server.settimeout(PATIENCE_S)
        connection, _ = server.accept()
        connection.sendall(b"here")
        sink.until_data(b"here")
        connection.close()


def test_a_silent_server_is_left_for_a_new_connection(links: list[Link]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(PATIENCE_S)
        sink = start(links, f"tcp://127.0.0.1:{server.getsockname()[1]}?timeout=1")
        silent, _ = server.accept()
        again, _ = server.accept()
        again.sendall(b"news")
        said: list[Chunk | LinkReport] = []
        while not (said and isinstance(said[-1], Chunk)):
            said.append(sink.items.get(timeout=PATIENCE_S))
        assert not [item for item in said if isinstance(item, LinkReport) and item.state is LinkState.ERROR], "silence is no fault"
        for connection in (silent, again):
            connection.close()


def test_tcp_listen_takes_one_receiver_after_the_other(links: list[Link]) -> None:
    port = free_port()
    sink = start(links, f"tcp-listen://127.0.0.1:{port}")
    sink.until_state(LinkState.CONNECTING)
    for text in (b"first", b"second"):
        connection = connect(port)
        connection.sendall(text)
        sink.until_data(text)
        connection.close()


def test_a_busy_port_is_named(links: list[Link]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        sink = start(links, f"tcp-listen://127.0.0.1:{taken.getsockname()[1]}")
        assert "in use" in sink.until_state(LinkState.ERROR).lower()


def test_udp_datagrams_arrive(links: list[Link]) -> None:
    port = free_port(socket.SOCK_DGRAM)
    sink = start(links, f"udp://127.0.0.1:{port}")
    sink.until_state(LinkState.WAITING)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.sendto(b"datagram", ("127.0.0.1", port))
        sink.until_data(b"datagram")


def test_serial_reads_and_writes_a_terminal(links: list[Link]) -> None:
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    sink = start(links, f"serial://{os.ttyname(theirs)}?baud=115200")
    sink.until_state(LinkState.WAITING)
    os.write(ours, b"\xb5\x62 bytes")
    sink.until_data(b"\xb5\x62 bytes")
    assert links[-1].write(b"correction")
    assert os.read(ours, 64) == b"correction"
    for end in (ours, theirs):
        os.close(end)


def test_a_missing_device_is_named(links: list[Link]) -> None:
    sink = start(links, "serial:///dev/no_such_receiver")
    assert "no_such_receiver" in sink.until_state(LinkState.ERROR)


def test_nothing_is_written_while_nothing_is_connected(links: list[Link]) -> None:
    start(links, f"tcp://127.0.0.1:{free_port()}").until_state(LinkState.ERROR)
    assert not links[-1].write(b"lost")


def connect(port: int) -> socket.socket:
    """Connect to a server that is about to listen (the link's thread reports before it does)."""
    for _ in range(200):
        try:
            return socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S)
        except ConnectionRefusedError:
            continue
    raise AssertionError("nobody listens")
