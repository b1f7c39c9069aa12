"""
The ROS 2 nodes; nothing else in the package imports rclpy.

A node converts messages, calls `bellows_ros.core` or `bellows_ros.workflows`, and converts back.
"""
