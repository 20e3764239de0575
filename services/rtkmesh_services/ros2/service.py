"""The ROS 2 bridge: chosen solvers, attitudes and all processes' states as topics; start, stop, restart as services."""

from collections import Counter
from math import isfinite
from typing import TYPE_CHECKING, Any, ClassVar

from rtkmesh_schemas.attitude import AttitudeMessage
from rtkmesh_schemas.config import Ros2Table
from rtkmesh_schemas.errors import DecodeError, VersionError
from rtkmesh_schemas.keys import ATT, ATT_FILTERED, SOL, STATUS, Role, Stream
from rtkmesh_schemas.solution import SolutionMessage
from rtkmesh_schemas.status import InputStatus, ServiceStatus
from rtkmesh_schemas.wire import decode
from rtkmesh_services.errors import ServiceError
from rtkmesh_services.ros2.conversion import diagnostic_of, fix_of, orientation_of, velocity_of
from rtkmesh_services.ros2.pose import Map, heading_quaternion_of, pose_of, twist_of
from rtkmesh_services.runtime.bus import Sample
from rtkmesh_services.runtime.calls import call
from rtkmesh_services.runtime.service import Context, Report, Service

if TYPE_CHECKING:
    from rtkmesh_services.ros2.node import BridgeNode

DIAGNOSTICS_NS = 1_000_000_000
COMMAND_DEADLINE_S = 2.0


class Ros2Service(Service):
    """Bridges keys to topics. Zenoh callbacks only fill the inbox; ROS callbacks run in rclpy's thread."""

    role: ClassVar[Role] = Role.ROS2

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._table: Ros2Table = context.deployment.ros2[context.id]
        self._solvers = self._table.solvers or tuple(context.deployment.solver)
        self._attitudes = self._table.attitudes or tuple(context.deployment.attitude)
        self._node: BridgeNode | None = None
        self._map = Map(*self._table.map_origin) if self._table.map_origin else None
        self._solutions: dict[str, SolutionMessage] = {}
        self._statuses: dict[str, ServiceStatus] = {}
        self._counts: Counter[str] = Counter()
        self._errors = 0
        self._diagnostics_ns = 0

    def warm(self) -> None:
        """Import rclpy and join the ROS graph."""
        try:
            from rtkmesh_services.ros2.node import BridgeNode
        except ImportError as error:
            raise ServiceError(
                f"rclpy cannot be imported ({error}): source your ROS 2 setup, or name its Python in [ros2.{self.context.id}] python"
            ) from error
        table = self._table
        node = BridgeNode(f"rtkmesh_{self.context.id}", table.frame_id, table.map_frame_id, table.base_frame_id)
        for name in self._solvers:
            node.add_solver(name, self._command)
        for name in self._attitudes:
            node.add_attitude(name, pose=name in self._table.poses)
        self._node = node

    def open(self) -> None:
        """Subscribe to what is bridged."""
        assert self._node is not None, "warm has made it"
        self._node.start()
        for name in self._solvers:
            self.context.subscribe(SOL.key(name), lane="sol", latest=True)
        for name in self._attitudes:
            self.context.subscribe(self._attitude_stream(name).key(name), lane="att", latest=True)
        self.context.subscribe(STATUS.expression(), lane="status", history=True, latest=True)

    def handle(self, item: Any) -> None:
        """Publish one message as ROS topics."""
        if not isinstance(item, Sample):
            return
        try:
            self._bridge(item)
        except (DecodeError, VersionError):
            self._errors += 1

    def tick(self, now_mono_ns: int) -> None:
        """Publish the diagnostics once a second."""
        if self._node is None or now_mono_ns - self._diagnostics_ns < DIAGNOSTICS_NS:
            return
        self._diagnostics_ns = now_mono_ns
        statuses = sorted(self._statuses.values(), key=lambda status: (status.role, status.id))
        self._node.publish_diagnostics(diagnostic_of(status, self._solutions.get(status.id)) for status in statuses)

    def report(self) -> Report:
        """Tell what was bridged."""
        bridged = InputStatus(name="bus", state="bridging", messages=self._counts.total(), errors=self._errors)
        return Report(inputs=[bridged], counters={f"published_{name}": count for name, count in self._counts.items()})

    def close(self) -> None:
        """Leave the ROS graph."""
        if self._node is not None:
            self._node.close()

    def _bridge(self, sample: Sample) -> None:
        assert self._node is not None, "open comes after warm"
        _, name, kind = sample.key.split("/")[:3]
        if kind == "status":
            self._statuses[name] = decode(ServiceStatus, sample.payload, sample.encoding)
        elif kind == "att":
            self._bridge_attitude(self._node, name, decode(AttitudeMessage, sample.payload, sample.encoding))
        else:
            solution = self._solutions[name] = decode(SolutionMessage, sample.payload, sample.encoding)
            self._node.publish_fix(name, fix_of(solution, self._systems(name)))
            self._counts["fix"] += 1
            if (velocity := velocity_of(solution)) is not None:
                self._node.publish_velocity(name, velocity)

    def _bridge_attitude(self, node: "BridgeNode", name: str, attitude: AttitudeMessage) -> None:
        orientation, heading = orientation_of(attitude), heading_quaternion_of(attitude)
        if orientation is not None and heading is not None:
            node.publish_heading(name, orientation)
            node.publish_heading_quaternion(name, heading)
            self._counts["heading"] += 1
        point = attitude.points.get(self._table.poses.get(name, ""))
        if point is None or not isfinite(point.height_m):
            return
        self._map = self._map or Map(point.lat_deg, point.lon_deg, point.height_m)
        if (pose := pose_of(attitude, point, self._map)) is not None:
            node.publish_pose(name, pose)
            self._counts["pose"] += 1
        if (twist := twist_of(attitude, point)) is not None:
            node.publish_twist(name, twist)
            self._counts["twist"] += 1

    def _attitude_stream(self, name: str) -> Stream:
        """Return the filtered attitudes of a process that has a filter."""
        table = self.context.deployment.attitude.get(name)
        return ATT_FILTERED if table is not None and table.filter is not None else ATT

    def _systems(self, solver: str) -> str:
        table = self.context.deployment.solver.get(solver)
        return "GREC" if table is None else table.systems

    def _command(self, name: str, operation: str) -> tuple[bool, str]:
        """Ask a solver (in rclpy's thread)."""
        replies = call(self.context.bus, name, operation, deadline_s=COMMAND_DEADLINE_S)
        return bool(replies) and replies[0].ok, replies[0].message if replies else f"{name} did not answer"


def create(context: Context) -> Service:
    """Return the bridge of a context."""
    return Ros2Service(context)
