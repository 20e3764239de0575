"""One solver, four outputs at once as processes, one of them blocked for good: the other three have everything."""

import socket
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tests.e2e.conftest import Deployment, free_besides

from rtkmesh_schemas.keys import SOL, TEXT
from rtkmesh_schemas.solution import SolutionMessage
from rtkmesh_schemas.status import State
from rtkmesh_schemas.wire import decode

COUNT = 150
DEPLOYMENT = """
[ingest.rover]
source = "sim://demo/rover?rate=20"
[ingest.base]
source = "sim://demo/base?rate=20"
[solver.rtk]
rover = "rover"
base = "base"
[output.log]
solver = "rtk"
target = "file://{folder}/%Y.pos::T"
format = "xyz"
single = true
[output.nmea]
solver = "rtk"
target = "tcp-listen://127.0.0.1:{nmea}"
format = "nmea"
single = true
[output.records]
solver = "rtk"
target = "zenoh://"
format = "stat"
status_level = "residual"
single = true
[output.stuck]
solver = "rtk"
target = "tcp://127.0.0.1:{stuck}"
format = "json"
maximum_delay_s = 1.0
"""


class Reader:
    """Reads a TCP server to its end."""

    def __init__(self, port: int) -> None:
        self.data = b""
        self._port = port
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        with socket.create_connection(("127.0.0.1", self._port), timeout=60.0) as connection:
            while piece := connection.recv(65536):
                self.data += piece

    def lines(self, word: str) -> list[str]:
        return [line for line in self.data.decode().splitlines() if line[3:6] == word]

    def join(self) -> None:
        self._thread.join(60.0)
        assert not self._thread.is_alive()


@pytest.mark.e2e
def test_three_outputs_are_complete_beside_one_that_is_blocked(
    up: Callable[..., Deployment], port: int, tmp_path: Path, compiled: None
) -> None:
    nmea_port = free_besides(port)
    with socket.socket() as stuck:
        stuck.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        stuck.bind(("127.0.0.1", 0))
        stuck.listen(1)
        deployment = up(DEPLOYMENT.format(folder=tmp_path, nmea=nmea_port, stuck=stuck.getsockname()[1]))
        running = {"rtk", "log", "nmea", "records"}
        deployment.until(lambda: running <= {id_ for id_, row in deployment.rows().items() if row["state"] == "RUNNING"}, 60.0)
        reader, solutions, records = Reader(nmea_port), [], []
        statuses = deployment.statuses()
        deployment.until(lambda: "nmea" in statuses and len(statuses["nmea"].inputs) == 3)
        deployment.bus.subscribe(TEXT.key("records"), lambda sample: records.append(sample.payload))
        deployment.bus.subscribe(SOL.key("rtk"), lambda sample: solutions.append(decode(SolutionMessage, sample.payload, sample.encoding)))
        deployment.until(lambda: len(solutions) > COUNT, 60.0)
        deployment.until(lambda: "too slow" in statuses["stuck"].reason, 60.0)
        assert [statuses[name].state for name in ("log", "nmea", "records")] == [State.RUNNING] * 3
        assert deployment.interrupt() == 0
        reader.join()
    [log] = tmp_path.glob("*.pos")
    lines = [line.split() for line in log.read_text().splitlines() if not line.startswith("%")]
    expected: list[Any] = [one for one in solutions if one.status][:COUNT]
    times = [f"{one.tow_s % 60.0:06.3f}" for one in expected]
    begin = next(number for number, line in enumerate(lines) if line[1].endswith(times[0]))
    assert [line[1][-6:] for line in lines[begin : begin + COUNT]] == times
    assert [int(line[5]) for line in lines[begin : begin + COUNT]] == [one.status for one in expected]
    sentences = [line.split(",") for line in reader.lines("GGA")]
    seconds = [f"{(one.tow_s - 18.0) % 60.0:05.2f}" for one in expected]
    begin = next(number for number, fields in enumerate(sentences) if fields[1][4:9] == seconds[0])
    assert [fields[1][4:9] for fields in sentences[begin : begin + COUNT]] == seconds
    positions = [line.split(",") for line in b"".join(records).decode().splitlines() if line.startswith("$POS")]
    tows = [f"{one.tow_s:.3f}" for one in expected]
    begin = next(number for number, fields in enumerate(positions) if fields[2] == tows[0])
    assert [fields[2] for fields in positions[begin : begin + COUNT]] == tows
    assert all(text.count(b"$SAT") > 4 for text in records[:COUNT])
    assert log.with_name(f"{log.name}.tag").read_bytes().startswith(b"TIMETAG RTKLIB")
