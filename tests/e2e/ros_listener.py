"""A plain ROS 2 program for the bridge's test: prints every message as a JSON line, calls a service for each line it reads."""

import json
import sys
import threading

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped, QuaternionStamped, TwistWithCovarianceStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Imu, NavSatFix
from std_srvs.srv import Trigger


def say(**values: object) -> None:
    print(json.dumps(values), flush=True)


def stamp(header) -> float:
    return header.stamp.sec + header.stamp.nanosec * 1e-9


def main() -> None:
    rclpy.init()
    node = rclpy.create_node("listener")
    node.create_subscription(
        NavSatFix, "/rtk/fix",
        lambda m: say(topic="fix", stamp=stamp(m.header), frame=m.header.frame_id, status=m.status.status, lat=m.latitude, lon=m.longitude,
                      alt=m.altitude, cov=list(m.position_covariance), kind=m.position_covariance_type), 10)  # fmt: skip
    node.create_subscription(
        TwistWithCovarianceStamped, "/rtk/fix_velocity",
        lambda m: say(topic="velocity", v=[m.twist.twist.linear.x, m.twist.twist.linear.y, m.twist.twist.linear.z],
                      cov=list(m.twist.covariance)), qos_profile_sensor_data)  # fmt: skip
    node.create_subscription(
        Imu, "/heading/heading",
        lambda m: say(topic="heading", q=[m.orientation.x, m.orientation.y, m.orientation.z, m.orientation.w],
                      cov=list(m.orientation_covariance), rate=m.angular_velocity_covariance[0]), 10)  # fmt: skip
    node.create_subscription(
        QuaternionStamped, "/heading/heading_quaternion",
        lambda m: say(topic="heading_quaternion", frame=m.header.frame_id,
                      q=[m.quaternion.x, m.quaternion.y, m.quaternion.z, m.quaternion.w]), 10)  # fmt: skip
    node.create_subscription(
        PoseWithCovarianceStamped, "/body/pose",
        lambda m: say(topic="pose", frame=m.header.frame_id, p=[m.pose.pose.position.x, m.pose.pose.position.y, m.pose.pose.position.z],
                      q=[m.pose.pose.orientation.x, m.pose.pose.orientation.y, m.pose.pose.orientation.z, m.pose.pose.orientation.w],
                      cov=list(m.pose.covariance)), 10)  # fmt: skip
    node.create_subscription(
        TwistWithCovarianceStamped, "/body/twist",
        lambda m: say(topic="twist", frame=m.header.frame_id, v=[m.twist.twist.linear.x, m.twist.twist.linear.y, m.twist.twist.linear.z],
                      w=[m.twist.twist.angular.x, m.twist.twist.angular.y, m.twist.twist.angular.z],
                      cov=list(m.twist.covariance)), 10)  # fmt: skip
    node.create_subscription(
        DiagnosticArray, "/diagnostics",
        lambda m: say(topic="diagnostics", messages={s.name: s.message for s in m.status}), 10)  # fmt: skip

    def serve_lines() -> None:
        for line in sys.stdin:
            name = line.strip()
            client = node.create_client(Trigger, name)
            if not client.wait_for_service(timeout_sec=10.0):
                say(service=name, success=False, message="no such service")
                continue
            future = client.call_async(Trigger.Request())
            future.add_done_callback(lambda f, name=name: say(service=name, success=f.result().success, message=f.result().message))

    threading.Thread(target=serve_lines, daemon=True).start()
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    say(ready=True)
    executor.spin()


if __name__ == "__main__":
    main()
