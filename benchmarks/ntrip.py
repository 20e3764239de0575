"""NTRIP: which frames arrive from every kind of caster, how late frames are, and what serving costs. RTKLIB's str2str beside.

Usage: python benchmarks/ntrip.py [--seconds 10] [--quick]

The first table: a scripted caster sends 8 frames in each of the ways that real casters do, or ends the connection after every frame for
20 connections (our pauses shortened to 20 ms for it, str2str's to 1 s); our link and `str2str` count what comes. The second: a caster
sends one epoch of 5 frames ten times a second to a number of clients in another process; latency is from handing the epoch to the caster
to its last byte at a client, CPU is of the caster's process (str2str is fed over TCP). Tables go to standard output.
"""

import argparse
import json
import queue
import resource
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from rtkmesh.codecs.framing import Framer
from rtkmesh.codecs.rtcm3_encode import frame
from rtkmesh_services.ingest.links import Chunk, Link, LinkReport
from rtkmesh_services.ingest.urls import parse_source
from rtkmesh_services.ntrip.caster import Caster
from rtkmesh_services.ntrip.source_table import MountPoint
from rtkmesh_services.runtime.backoff import Backoff

FRAMES = [frame(bytes([0x43, 0x50, number]) + bytes(range(150))) for number in range(8)]
V2 = b"HTTP/1.1 200 OK\r\nNtrip-Version: Ntrip/2.0\r\nContent-Type: gnss/data\r\n"
DROPS = 20
QUICK = Backoff(0.02, 0.05, refused_first_s=1.0)
PER_EPOCH, RATE_HZ = 5, 10


def chunks(pieces: list[bytes], extension: bytes = b"") -> bytes:
    return b"".join(b"%x%b\r\n%b\r\n" % (len(piece), extension, piece) for piece in pieces)


def cut(data: bytes, size: int) -> list[bytes]:
    return [data[at : at + size] for at in range(0, len(data), size)]


CHUNKED = V2 + b"Transfer-Encoding: chunked\r\n\r\n"
ALL = b"".join(FRAMES)
# name -> what is sent, piece by piece; a connection each for the last row
WAYS: dict[str, list[bytes]] = {
    "v1 stream, no blank line": [b"ICY 200 OK\r\n", *FRAMES],
    "v1 stream, blank line": [b"ICY 200 OK\r\n\r\n", *FRAMES],
    "v2 stream": [V2 + b"\r\n" + FRAMES[0], *FRAMES[1:]],
    "v2 chunked": [CHUNKED + chunks(FRAMES[:1]), *(chunks([one]) for one in FRAMES[1:])],
    "v2 chunked, frames split over chunks": [CHUNKED, *(chunks([piece]) for piece in cut(ALL, 37))],
    "v2 chunked, extensions": [CHUNKED, *(chunks([one], b";a=b") for one in FRAMES)],
    "v2, Content-Type missing": [b"HTTP/1.1 200 OK\r\n\r\n", *FRAMES],
}


@dataclass
class Script:
    """A caster that sends what it is told on each connection; with ``drop`` one frame, then it closes."""

    pieces: list[bytes]
    drop: bool = False
    served: int = 0
    closing: threading.Event = field(default_factory=threading.Event)

    def __post_init__(self) -> None:
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.port = self.listener.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                connection, _ = self.listener.accept()
                threading.Thread(target=self._serve, args=(connection,), daemon=True).start()

    def _serve(self, connection: socket.socket) -> None:
        with suppress(OSError), connection:
            connection.recv(4096)
            self.served += 1
            if self.drop:
                connection.sendall(b"ICY 200 OK\r\n" + FRAMES[self.served % 8])
                return
            for piece in self.pieces:
                connection.sendall(piece)
                time.sleep(0.005)
            self.closing.wait(30.0)


class OurClient:
    """Our link; counts whole frames."""

    def __init__(self, port: int, backoff: Backoff | None = QUICK) -> None:
        self.items: queue.Queue[Chunk | LinkReport] = queue.Queue()
        self.link = Link(parse_source(f"ntrip://u:p@127.0.0.1:{port}/M"), self.items.put, backoff=backoff)
        self.link.start()
        self._framer = Framer()
        self._count = 0

    def frames(self) -> int:
        while not self.items.empty():
            item = self.items.get()
            self._count += len(self._framer.feed(item.data)) if isinstance(item, Chunk) else 0
        return self._count

    def close(self) -> None:
        self.link.stop()


class RtklibClient:
    """RTKLIB's str2str into a file."""

    def __init__(self, port: int) -> None:
        self.log = Path(tempfile.mkstemp(suffix=".rtcm3")[1])
        command = ["str2str", "-in", f"ntrip://u:p@127.0.0.1:{port}/M", "-out", f"file://{self.log}", "-r", "1000", "-s", "3000"]
        self.process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def frames(self) -> int:
        framer = Framer()
        return len(framer.feed(self.log.read_bytes())) + len(framer.flush())

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        self.log.unlink()


def delivered(make: Callable[[int], OurClient | RtklibClient], script: Script, expected: int, patience_s: float) -> str:
    """Return how many frames of those expected a client gets, and how long it takes."""
    begun_s = time.monotonic()
    client = make(script.port)
    try:
        while client.frames() < expected and time.monotonic() - begun_s < patience_s:
            time.sleep(0.02)
        took_s = time.monotonic() - begun_s
        return f"{client.frames()} of {expected}" + (f" in {took_s:.1f} s" if client.frames() >= expected else "")
    finally:
        client.close()
        script.closing.set()
        script.listener.close()


def deliveries(quick: bool) -> None:
    makers: list[tuple[str, Callable[[int], OurClient | RtklibClient]]] = [("rtkmesh", OurClient)]
    if shutil.which("str2str"):
        makers.append(("str2str 2.4.3", RtklibClient))
    print("| caster sends | " + " | ".join(f"{name}: frames" for name, _ in makers) + " |")
    print("|---|" + "---|" * len(makers))
    patience_s = 4.0 if quick else 8.0
    for name, pieces in WAYS.items():
        print(
            f"| {name} | " + " | ".join(delivered(make, Script(pieces), len(FRAMES), patience_s) for _, make in makers) + " |", flush=True
        )
    row = [delivered(make, Script([], drop=True), DROPS, patience_s + (2.0 * DROPS if not quick else 0.0)) for _, make in makers]
    print(f"| one frame a connection, {DROPS} drops, pauses shortened (20 ms; 1 s) | " + " | ".join(row) + " |", flush=True)


class Reader:
    """A client in a thread; notes when each epoch's last byte came."""

    def __init__(self, port: int) -> None:
        self.connection = socket.create_connection(("127.0.0.1", port), timeout=30.0)
        self.connection.sendall(b"GET /M HTTP/1.0\r\nUser-Agent: NTRIP x\r\nAuthorization: Basic dTpw\r\n\r\n")
        self.came_s: dict[int, float] = {}
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        framer = Framer()
        with suppress(OSError):
            while data := self.connection.recv(65536):
                now_s = time.monotonic()
                for one in framer.feed(data):
                    number = int.from_bytes(one.data[6:9], "big")
                    if number % PER_EPOCH == PER_EPOCH - 1:
                        self.came_s[number // PER_EPOCH] = now_s


def epoch(number: int) -> list[bytes]:
    return [frame(bytes([0x43, 0x50, 0]) + (number * PER_EPOCH + k).to_bytes(3, "big") + bytes(200)) for k in range(PER_EPOCH)]


class Readers:
    """Clients in a process of their own."""

    def __init__(self, port: int, count: int) -> None:
        command = [sys.executable, __file__, "--readers", str(port), str(count)]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        self.process.stdout.readline()  # all are connected

    def came_s(self) -> list[dict[str, float]]:
        """End them; return when each epoch came to each."""
        found: list[dict[str, float]] = json.loads(self.process.communicate("")[0])
        return found


def read(port: int, count: int) -> None:
    """Be the clients; what they saw goes to standard output when standard input ends."""
    Framer().feed(ALL)
    readers = [Reader(port) for _ in range(count)]
    print("connected", flush=True)
    sys.stdin.read()
    print(json.dumps([reader.came_s for reader in readers]))


def latencies(send: Callable[[list[bytes]], None], readers: Readers, seconds: float) -> tuple[float, float, float]:
    """Return the median, the 99th percentile (ms) and the share of epochs that came, of all clients."""
    sent_s: dict[int, float] = {}
    for number in range(int(seconds * RATE_HZ)):
        sent_s[number] = time.monotonic()
        send(epoch(number))
        time.sleep(1.0 / RATE_HZ)
    time.sleep(0.5)
    came = readers.came_s()
    late_ms = [(one[str(n)] - sent_s[n]) * 1e3 for one in came for n in sent_s if str(n) in one]
    return float(np.percentile(late_ms, 50)), float(np.percentile(late_ms, 99)), len(late_ms) / (len(sent_s) * len(came))


def serve_ours(clients: int, seconds: float) -> None:
    caster = Caster("127.0.0.1", 0, {"M": MountPoint("M")}, {"u": "p"}, maximum_clients=200)
    caster.start()
    readers = Readers(caster.port, clients)
    while len(caster.clients()) < clients:
        time.sleep(0.01)

    def send(frames: list[bytes]) -> None:
        for one in frames:
            caster.publish("M", one)

    before = resource.getrusage(resource.RUSAGE_SELF)
    p50, p99, share = latencies(send, readers, seconds)
    after = resource.getrusage(resource.RUSAGE_SELF)
    cpu = (after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime) / seconds * 100.0
    caster.close()
    print(f"| rtkmesh | {clients} | {p50:.2f} | {p99:.2f} | {100 * share:.1f} | {cpu:.1f} |", flush=True)


def serve_rtklib(clients: int, seconds: float) -> None:
    with socket.create_server(("127.0.0.1", 0)) as feeder, socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
        probe.close()
        command = ["str2str", "-in", f"tcpcli://127.0.0.1:{feeder.getsockname()[1]}", "-out", f"ntripc://u:p@:{port}/M"]
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        feed, _ = feeder.accept()
        feed.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        time.sleep(1.0)
        readers = Readers(port, clients)
        time.sleep(1.0)
        p50, p99, share = latencies(lambda frames: feed.sendall(b"".join(frames)), readers, seconds)
        ticks = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
        cpu = (int(ticks[11]) + int(ticks[12])) / (seconds + 2.0)
        process.kill()
        process.wait()
    print(f"| str2str 2.4.3 | {clients} | {p50:.2f} | {p99:.2f} | {100 * share:.1f} | {cpu:.1f} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--data", help="not needed")
    parser.add_argument("--readers", type=int, nargs=2, metavar=("PORT", "COUNT"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.readers:
        read(*options.readers)
        return
    Framer().feed(ALL)
    deliveries(options.quick)
    print("\n| caster | clients | p50 ms | p99 ms | epochs that came % | CPU % of a core |\n|---|---|---|---|---|---|")
    seconds = 3.0 if options.quick else options.seconds
    for clients in (1, 30) if options.quick else (1, 30, 100):
        serve_ours(clients, seconds)
        if shutil.which("str2str") and clients <= 30:  # it takes 32 clients
            serve_rtklib(clients, seconds)


if __name__ == "__main__":
    main()
