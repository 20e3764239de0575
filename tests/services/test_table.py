"""What people see: the board's collection, the tables at any width, the demo's score."""

import math
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest
from rich.console import Console

from rtkmesh.gnss.frames import ecef_from_geodetic, enu_from_ecef
from rtkmesh.gnss.time import GpsTime
from rtkmesh_schemas.attitude import AttitudeMessage
from rtkmesh_schemas.keys import ATT, SOL, STATUS
from rtkmesh_schemas.solution import SolutionMessage
from rtkmesh_schemas.status import ServiceStatus, State
from rtkmesh_services.cli.board import Board
from rtkmesh_services.cli.demo import Score
from rtkmesh_services.cli.table import Truth, View, process_table, solution_table, supervised
from rtkmesh_services.runtime.clock import ManualClock
from rtkmesh_services.runtime.memory_bus import MemoryBus, MemoryNetwork

NAN3 = (math.nan,) * 3
NAN9 = (math.nan,) * 9
SITE = ecef_from_geodetic(math.radians(52.5), math.radians(13.4), 80.0)
TO_ENU = enu_from_ecef(math.radians(52.5), math.radians(13.4))


def blank(type_: type[msgspec.Struct]) -> dict[str, Any]:
    """Return a value for every field that needs one: NaN for figures."""
    of = {int: 0, float: math.nan, str: "", list[str]: []}
    fields = [field for field in msgspec.structs.fields(type_) if field.required]
    return {field.name: of.get(field.type, NAN9 if "cov" in field.name else NAN3) for field in fields}


def solution(**values: Any) -> SolutionMessage:
    message = blank(SolutionMessage) | {
        "source": "rtk",
        "status": 1,
        "status_name": "FIX",
        "mode": "kinematic",
        "rover": "rover",
        "base": "base",
    }
    return SolutionMessage(**message | {"week": 2400, "tow_s": 100.0} | values)


def attitude(**values: Any) -> AttitudeMessage:
    message = blank(AttitudeMessage) | {"status": 1, "status_name": "FIX", "integrity": "ok", "week": 2400, "tow_s": 100.0}
    return AttitudeMessage(**message | values)


def process(id_: str, pid: int = 7, **values: Any) -> ServiceStatus:
    return ServiceStatus(id=id_, role="solver", state=State.RUNNING, start_id="a", heartbeat=1, pid=pid, **values)


class Network:
    """A network with a board on it."""

    def __init__(self) -> None:
        self.clock = ManualClock()
        self.network = MemoryNetwork(clock=self.clock)
        self.board = Board()
        self.board.attach(MemoryBus("viewer", self.network))

    def publish(self, stream: Any, id_: str, value: Any, **more: Any) -> None:
        MemoryBus(id_, self.network).publish(stream, value, **more)

    def take(self) -> Board:
        while self.board.take(0.0):
            pass
        return self.board


def printed(renderable: Any, width: int = 200) -> str:
    out = Console(width=width, no_color=True, force_terminal=False, highlight=False)
    with out.capture() as text:
        out.print(renderable)
    return text.get()


def test_board_counts_fixes_and_measures_latency_from_the_last_byte_of_the_epoch() -> None:
    network = Network()
    for step in range(4):
        received_ns = network.clock.mono_ns()
        network.clock.advance(0.005)
        network.publish(SOL, "rtk", solution(status=1 if step else 2, received_mono_ns=received_ns))
    track = network.take().solutions["rtk"]
    assert (track.count, track.fixes) == (4, 3)
    quantiles = track.latency_ms.quantiles(network.clock.mono_ns())
    assert quantiles is not None
    assert quantiles.p50 == pytest.approx(5.0)


def test_integrity_and_protection_levels_have_their_columns() -> None:
    network = Network()
    network.publish(SOL, "rtk", solution(integrity="failed", protection_horizontal_m=0.031, protection_vertical_m=math.inf))
    text = printed(solution_table(network.take().solutions, network.clock.mono_ns()))
    assert "failed" in text
    assert "0.031 -" in text


def test_bytes_that_are_no_message_are_counted_and_change_nothing() -> None:
    network = Network()
    network.publish(SOL, "rtk", b"\xc1\xff")
    assert network.take().solutions == {}
    assert network.board.refused == 1


def test_latency_of_another_hosts_clock_is_left_out() -> None:
    network = Network()
    network.publish(SOL, "rtk", solution(received_mono_ns=network.clock.mono_ns() + 10**12))
    assert network.take().solutions["rtk"].latency_ms.quantiles(network.clock.mono_ns()) is None


@pytest.mark.parametrize("width", range(80, 160, 8))
def test_the_truths_column_is_shown_whole_and_columns_stay_while_digits_change(width: int) -> None:
    """Signs and digits of a moving baseline make no column come or go, and none is cut."""
    shown = []
    for east_m in (0.6, -0.6):
        network = Network()
        network.publish(SOL, "heading_rtk", solution(mode="moving-base", baseline_enu_m=(east_m, 0.8, -0.0), age_s=-1e-9, ratio=3.25))
        truth = Truth(lambda _id, _message: (0.001, -0.002, 0.003), lambda _id, _message: None)
        lines = printed(solution_table(network.take().solutions, network.clock.mono_ns(), truth, width), width).splitlines()
        assert "+0.001 -0.002 +0.003" in lines[3]
        assert max(len(line) for line in lines) <= width
        assert "-0.0 " not in lines[3]
        shown.append(lines[1].split())
    assert shown[0] == shown[1]


@pytest.mark.parametrize("width", [40, 60, 80, 100, 140, 200])
def test_table_fits_any_width_and_always_tells_id_and_state(width: int) -> None:
    network = Network()
    network.publish(SOL, "rtk", solution(lat_deg=52.5, lon_deg=13.4, height_m=80.0, age_s=0.0, ratio=12.5))
    network.publish(SOL, "heading_rtk", solution(mode="moving-base", status=2, status_name="FLOAT", baseline_enu_m=(0.6, 0.8, 0.0)))
    text = printed(solution_table(network.take().solutions, network.clock.mono_ns(), None, width), width)
    lines = text.splitlines()
    assert max(len(line) for line in lines) <= width
    assert any("rtk" in line and "FIX" in line for line in lines)
    assert any("heading_rtk" in line and "FLOAT" in line for line in lines)
    if width >= 100:
        assert "52.50000000 13.40000000 80.000" in text
        assert "1.000 m  E+0.600 N+0.800 U+0.000" in text


def test_solution_that_has_stopped_coming_says_how_old_it_is() -> None:
    network = Network()
    network.publish(SOL, "rtk", solution())
    network.take()
    network.clock.advance(8.0)
    assert "FIX 8 s ago" in printed(solution_table(network.board.solutions, network.clock.mono_ns()))


def test_processes_come_from_control_and_the_rest_from_their_own_status() -> None:
    network = Network()
    row = {"id": "rtk", "role": "solver", "state": "WAITING", "pid": 0, "restarts": 2, "uptime_s": 0.0, "reason": "exit code 70: boom"}
    control = ServiceStatus(id="control", role="control", state=State.RUNNING, start_id="a", heartbeat=1, pid=1, data={"processes": [row]})
    network.publish(STATUS, "control", control)
    network.publish(STATUS, "rtk", process("rtk"))
    network.publish(STATUS, "elsewhere", process("elsewhere", pid=9))
    rows = supervised(network.take())
    assert [found["id"] for found in rows] == ["rtk", "control", "elsewhere"]
    text = printed(process_table(rows, network.board.statuses, network.clock.mono_ns()))
    assert "exit code 70: boom" in text
    assert text.count("RUNNING") == 4  # control and elsewhere, process and service: the waiting solver's old word does not count
    assert "elsewhere" in printed(View(network.board).render())


def truth_at(speed_mps: float) -> Callable[[GpsTime], Any]:
    """A vehicle that drives north; its second antenna is one metre ahead."""

    class Truth:
        heading_rad = 0.0

        def __init__(self, time: GpsTime) -> None:
            here = SITE + TO_ENU.T @ np.array([0.0, speed_mps * (time.tow_s - 100.0), 0.0])
            self.antennas_ecef_m = {"rover": here, "heading": here + TO_ENU.T @ np.array([0.0, 1.0, 0.0])}

    return Truth


def score(speed_mps: float = 0.0) -> Score:
    at = truth_at(speed_mps)
    made = Score(lambda: {"rover": (at, "rover"), "rover2": (at, "heading")})
    made.prepare()
    return made


def at_enu(east: float, north: float, up: float) -> tuple[float, float, float]:
    x, y, z = SITE + TO_ENU.T @ np.array([east, north, up])
    return float(x), float(y), float(z)


def test_error_of_a_position_is_in_east_north_up() -> None:
    error = score().position_error("rtk", solution(position_ecef_m=at_enu(0.1, -0.2, 0.3)))
    assert error == pytest.approx((0.1, -0.2, 0.3), abs=1e-6)


def test_truth_is_taken_at_the_true_time_not_at_the_receivers() -> None:
    """A receiver clock one millisecond ahead tags what it saw a millisecond too late."""
    error = score(speed_mps=15.0).position_error("rtk", solution(position_ecef_m=at_enu(0.0, -0.015, 0.0), receiver_clock_s=1e-3))
    assert error == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)


def test_error_of_a_moving_baseline_is_that_of_the_difference() -> None:
    baseline = TO_ENU.T @ np.array([0.01, 1.0, 0.0])
    message = solution(mode="moving-base", rover="rover2", base="rover", baseline_ecef_m=tuple(baseline.tolist()))
    assert score().position_error("heading_rtk", message) == pytest.approx((0.01, 0.0, 0.0), abs=1e-6)


def test_error_of_a_heading_goes_the_short_way_round() -> None:
    assert score().heading_error("heading", attitude(heading_rad=math.tau - math.radians(1.0))) == pytest.approx(-1.0)


def test_summary_counts_from_the_first_epoch_to_the_first_fix() -> None:
    made = score()
    for step in range(10):
        status = 2 if step < 4 else 1
        made.solution("rtk", solution(tow_s=100.0 + 0.5 * step, status=status, position_ecef_m=at_enu(0.03, 0.04, 0.0)), 5.0)
        made.solution("heading_rtk", solution(status=1), 5.0)
    made.attitude("heading", attitude(heading_rad=math.radians(0.5)), 5.0)

    class Ran:
        seconds, reason, rows = 5.0, "", [{"restarts": 1}]

    summary = made.summary(Ran())  # type: ignore[arg-type]  what it looks at of a Foreground
    assert summary["epochs"] == 10
    assert summary["fix_pct"] == 60.0
    assert summary["ttff_s"] == 2.0
    assert summary["horizontal_rms_m"] == 0.05
    assert summary["heading_rms_deg"] == 0.5
    assert summary["latency_p50_ms"] == 5.0
    assert summary["restarts"] == 1


def test_attitude_table_shows_degrees() -> None:
    network = Network()
    covariance = (math.radians(0.2) ** 2, 0.0, 0.0, 0.0, math.radians(0.4) ** 2, 0.0, 0.0, 0.0, math.nan)
    network.publish(ATT, "heading", attitude(heading_rad=math.radians(57.3), pitch_rad=0.0, covariance_rad2=covariance))
    text = printed(View(network.take()).render())
    assert "57.30 ± 0.20" in text
    assert "0.00 ± 0.40" in text
