"""Corrections and base stations with real processes over real Zenoh, and receivers behind real pseudo-terminals."""

import socket
import threading
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.services.simulated_receiver import PLACE, SimulatedReceiver, running
from tests.services.test_corrections import EPOCHS, STATION_FRAMES, epoch

from rtkmesh_schemas.keys import REF
from rtkmesh_schemas.status import ServiceStatus, State
from rtkmesh_services.ingest.base.presets import PresetStore
from rtkmesh_services.ntrip.frames import message_number
from rtkmesh_services.runtime.calls import call
from rtkmesh_services.runtime.state_files import STATE_VARIABLE

pytestmark = pytest.mark.e2e
BYTES_PER_S = 960.0


class BaseServer:
    """A base behind TCP that sends an epoch every ``period_s``, its place with every fifth."""

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._server = socket.create_server(("127.0.0.1", 0))
        self._stop = threading.Event()
        self.epochs = 0
        self.port: int = self._server.getsockname()[1]
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        connection, _ = self._server.accept()
        with connection:
            while not self._stop.wait(self._period_s):
                place = STATION_FRAMES if self.epochs % 5 == 0 else []
                connection.sendall(b"".join([*place, *epoch(self.epochs)]))
                self.epochs += 1

    def stop(self) -> None:
        self._stop.set()
        self._server.close()


@pytest.fixture
def base() -> Iterator[BaseServer]:
    server = BaseServer(0.1)
    yield server
    server.stop()


def start(site: Any, *names: str, **environment: str) -> None:
    for name in names:
        site.start("-m", "rtkmesh_services.cli.main", "run", "ingest", "--id", name, "--config", str(site.config), environment=environment)


def test_a_slow_receiver_gets_whole_epochs_in_time_and_every_place(site: Any, base: BaseServer):
    """The base sends more than twice what 9600 baud carry, and the receiver sends nothing but what it thinks of corrections."""
    sent_bytes_per_s = sum(map(len, EPOCHS[0])) / 0.1
    assert sent_bytes_per_s > 2.0 * BYTES_PER_S
    with running(SimulatedReceiver(bytes_per_s=BYTES_PER_S, second_s=0.2)) as receiver, site.bus() as bus:
        site.config.write_text(
            f'[hub]\nlisten = ["{site.endpoint}"]\n[ingest.base]\nsource = "tcp://127.0.0.1:{base.port}"\n'
            f'[ingest.rover]\nsource = "serial://{receiver.path}?baud=9600"\n[ingest.rover.corrections]\nfrom = ["base"]\nset = "full"\n'
        )
        start(site, "rover", "base")
        status = site.status_until(
            bus, "rover", lambda status: told(status)["written_bytes"] > 3500.0 and told(status)["dropped_epochs"] > 10, 120.0
        )
        corrections = told(status)
        site.until(lambda: len(receiver.corrections) >= sum(row["written"] for row in corrections["messages"].values()))
        frames = list(receiver.corrections)
    got = [message_number(frame.data) for frame in frames]
    assert corrections["link_bytes_per_s"] == BYTES_PER_S
    observations = [number for number in got if number in (1077, 1087, 1097, 1127)]
    whole = len(observations) // 4
    assert observations[: 4 * whole] == [1077, 1087, 1097, 1127] * whole, "no epoch is cut"
    times = [frame.data[6:10] for frame in frames if frame.kind == "1077"]
    assert times == sorted(times)
    rows = corrections["messages"]
    for number in map(str, {message_number(frame) for frame in STATION_FRAMES}):
        assert rows[number]["dropped"] == 0
        assert rows[number]["written"] + rows[number]["replaced"] >= rows[number]["queued"] - 1
        assert rows[number]["written"] >= 5
    assert corrections["waited_s"] < 3.5
    feedback = corrections["feedback"]["messages"]
    assert feedback["1077"]["used"] > 5
    assert set(feedback) == {str(number) for number in got}
    row = next(row for row in status.inputs if row.name == "corrections")
    assert (row.state, row.dropped > 20) == ("connected", True)


def told(status: ServiceStatus) -> Any:
    return status.data.get("corrections") or {"written_bytes": 0.0, "dropped_epochs": 0}


def test_a_receiver_that_sends_nothing_gets_its_corrections(site: Any, base: BaseServer):
    """The writer does not wait for the reader (a silent receiver starved the corrections of others)."""
    with running(SimulatedReceiver(second_s=1e6)) as receiver, site.bus():
        receiver.used = 0
        site.config.write_text(
            f'[hub]\nlisten = ["{site.endpoint}"]\n[ingest.base]\nsource = "tcp://127.0.0.1:{base.port}"\n'
            f'[ingest.rover]\nsource = "serial://{receiver.path}"\n[ingest.rover.corrections]\nfrom = ["base"]\n'
        )
        start(site, "rover", "base")
        site.until(lambda: len(receiver.corrections) > 40, 120.0)
        counts = Counter(frame.kind for frame in receiver.corrections)
    assert set(counts) == {"1006", "1230", "1077", "1087", "1097", "1127"}, "the basic set"


def test_a_base_station_surveys_saves_and_is_commanded(site: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv(STATE_VARIABLE, str(tmp_path / "state"))
    with running(SimulatedReceiver()) as receiver, site.bus() as bus:
        site.config.write_text(
            f'[hub]\nlisten = ["{site.endpoint}"]\n[ingest.base]\nsource = "serial://{receiver.path}"\n[ingest.base.base_station]\n'
            'mode = "preset"\npreset = "roof"\nreceiver = "ublox"\nminimum_s = 20\naccuracy_m = 2.0\n'
        )
        start(site, "base", **{STATE_VARIABLE: str(tmp_path / "state")})
        site.status_until(bus, "base", lambda status: (status.data.get("base_station") or {}).get("state") == "surveyed", 120.0)
        [answer] = call(bus, "base", "survey_status", {}, 5.0)
        assert answer.data["position_ecef_m"] == pytest.approx(PLACE, abs=2e-4)
        saved = PresetStore(tmp_path / "state").get("roof")
        assert saved is not None
        assert saved.position_ecef_m == pytest.approx(PLACE, abs=2e-4)
        [answer] = call(bus, "base", "use_preset", {"name": "roof", "unchecked": True}, 5.0)
        assert answer.ok
        site.until(lambda: receiver.mode == 2)
        status = site.status_until(bus, "base", lambda status: status.data["base_station"]["state"] == "fixed")
        assert status.state is State.RUNNING
        seen = []
        bus.subscribe(REF.key("base"), seen.append, history=True)
        site.until(lambda: seen)
