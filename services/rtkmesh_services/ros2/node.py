"""The ROS 2 side of the bridge. The only module that imports rclpy; it comes from the user's ROS installation."""

# rclpy and its messages carry no types that a checker without ROS could see.
# pyright: reportMissingImports=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false, reportUnknownParameterType=false, reportMissingTypeStubs=false

import threading
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Any, Final

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped, QuaternionStamped, TwistWithCovarianceStamped
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import Imu, NavSatFix
from std_srvs.srv import Trigger

from rtkmesh_services.ros2.conversion import Diagnostic, Fix, Orientation, Stamp, Velocity
from rtkmesh_services.ros2.pose import HeadingQuaternion, Pose, Twist

QOS_DEPTH: Final = 10  # reliable, volatile: matches reliable and sensor-data subscribers
OPERATIONS: Final = ("start", "stop", "restart")
Command = Callable[[str, str], tuple[bool, str]]


class BridgeNode:
    """Publishers and services of one node, spun by a thread of its own.

    Topics: ``/{id}/fix``, ``fix_velocity``, ``heading``, ``heading_quaternion``, ``pose``, ``twist``.
    """

    def __init__(self, name: str, frame_id: str, map_frame_id: str, base_frame_id: str) -> None:
        self._frame_id, self._map_frame_id, self._base_frame_id = frame_id, map_frame_id, base_frame_id
        self._context = rclpy.Context()
        rclpy.init(args=[], context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self._node = rclpy.create_node(name, context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._publishers: dict[tuple[str, str], Any] = {}
        self._diagnostics = self._node.create_publisher(DiagnosticArray, "/diagnostics", QOS_DEPTH)
        self._thread = threading.Thread(target=self._spin, daemon=True, name="rclpy")

    def start(self) -> None:
        """Begin to serve."""
        self._thread.start()

    def add_solver(self, name: str, command: Command) -> None:
        """Offer a solver's topics and its services start, stop, restart."""
        self._publisher(name, "fix", NavSatFix)
        self._publisher(name, "fix_velocity", TwistWithCovarianceStamped)
        for operation in OPERATIONS:
            self._node.create_service(Trigger, f"/{name}/{operation}", _trigger(name, operation, command))

    def add_attitude(self, name: str, *, pose: bool) -> None:
        """Offer an attitude's topics; ``pose``: those of a point of the body, too."""
        self._publisher(name, "heading", Imu)
        self._publisher(name, "heading_quaternion", QuaternionStamped)
        if pose:
            self._publisher(name, "pose", PoseWithCovarianceStamped)
            self._publisher(name, "twist", TwistWithCovarianceStamped)

    def publish_fix(self, name: str, fix: Fix) -> None:
        """Publish a position."""
        publisher = self._publishers[name, "fix"]
        if not publisher.get_subscription_count():
            return
        message = NavSatFix()
        _head(message.header, fix.stamp, self._frame_id)
        message.status.status, message.status.service = fix.status, fix.service
        message.latitude, message.longitude, message.altitude = fix.latitude, fix.longitude, fix.altitude
        message.position_covariance = list(fix.position_covariance)
        message.position_covariance_type = fix.position_covariance_type
        publisher.publish(message)

    def publish_velocity(self, name: str, velocity: Velocity) -> None:
        """Publish a velocity in ENU axes."""
        publisher = self._publishers[name, "fix_velocity"]
        if not publisher.get_subscription_count():
            return
        message = TwistWithCovarianceStamped()
        _head(message.header, velocity.stamp, self._map_frame_id)
        linear = message.twist.twist.linear
        linear.x, linear.y, linear.z = velocity.linear
        message.twist.covariance = list(velocity.covariance)
        publisher.publish(message)

    def publish_heading(self, name: str, orientation: Orientation) -> None:
        """Publish an orientation."""
        publisher = self._publishers[name, "heading"]
        if not publisher.get_subscription_count():
            return
        message = Imu()
        _head(message.header, orientation.stamp, self._base_frame_id)
        q = message.orientation
        q.x, q.y, q.z, q.w = orientation.quaternion
        message.orientation_covariance = list(orientation.covariance)
        if orientation.rate is None:
            message.angular_velocity_covariance[0] = -1.0  # REP-145: not measured
        else:
            turning = message.angular_velocity
            turning.x, turning.y, turning.z = orientation.rate
            message.angular_velocity_covariance = list(orientation.rate_covariance)
        message.linear_acceleration_covariance[0] = -1.0
        publisher.publish(message)

    def publish_heading_quaternion(self, name: str, heading: HeadingQuaternion) -> None:
        """Publish a heading alone, in the map's axes."""
        publisher = self._publishers[name, "heading_quaternion"]
        if publisher.get_subscription_count():
            message = QuaternionStamped()
            _head(message.header, heading.stamp, self._map_frame_id)
            q = message.quaternion
            q.x, q.y, q.z, q.w = heading.quaternion
            publisher.publish(message)

    def publish_pose(self, name: str, pose: Pose) -> None:
        """Publish where the base frame is in the map."""
        publisher = self._publishers[name, "pose"]
        if publisher.get_subscription_count():
            message = PoseWithCovarianceStamped()
            _head(message.header, pose.stamp, self._map_frame_id)
            p, q = message.pose.pose.position, message.pose.pose.orientation
            p.x, p.y, p.z = pose.position
            q.x, q.y, q.z, q.w = pose.quaternion
            message.pose.covariance = list(pose.covariance)
            publisher.publish(message)

    def publish_twist(self, name: str, twist: Twist) -> None:
        """Publish how the base frame moves, in its own axes."""
        publisher = self._publishers[name, "twist"]
        if publisher.get_subscription_count():
            message = TwistWithCovarianceStamped()
            _head(message.header, twist.stamp, self._base_frame_id)
            linear, angular = message.twist.twist.linear, message.twist.twist.angular
            linear.x, linear.y, linear.z = twist.linear
            angular.x, angular.y, angular.z = twist.angular
            message.twist.covariance = list(twist.covariance)
            publisher.publish(message)

    def publish_diagnostics(self, diagnostics: Iterable[Diagnostic]) -> None:
        """Publish what the processes tell of themselves."""
        message = DiagnosticArray()
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.status = [_status(diagnostic) for diagnostic in diagnostics]
        self._diagnostics.publish(message)

    def close(self) -> None:
        """End the thread and leave ROS."""
        self._context.try_shutdown()
        self._thread.join(1.0)

    def _publisher(self, name: str, topic: str, kind: Any) -> None:
        self._publishers[name, topic] = self._node.create_publisher(kind, f"/{name}/{topic}", QOS_DEPTH)

    def _spin(self) -> None:
        with suppress(ExternalShutdownException):
            while self._context.ok():
                self._executor.spin_once(timeout_sec=0.2)


def _trigger(name: str, operation: str, command: Command) -> Callable[[Any, Any], Any]:
    def serve(_: Any, response: Any) -> Any:
        response.success, response.message = command(name, operation)
        return response

    return serve


def _head(header: Any, stamp: Stamp, frame_id: str) -> None:
    header.stamp.sec, header.stamp.nanosec, header.frame_id = stamp.sec, stamp.nanosec, frame_id


def _status(diagnostic: Diagnostic) -> Any:
    values = [KeyValue(key=key, value=value) for key, value in diagnostic.values]
    return DiagnosticStatus(level=bytes([diagnostic.level]), name=diagnostic.name, message=diagnostic.message, values=values)
