"""
One complete job each: files in, `bellows_ros.core` in the middle, files out.

Prints nothing and knows no ROS, so that commands, nodes and scripts share the same work.
"""
