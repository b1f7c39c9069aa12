"""
Join the rest of the package to ROS 2; nothing else in it imports rclpy.

A node converts messages, calls `bellows_ros.core` or `bellows_ros.workflows`, and converts back.
"""
