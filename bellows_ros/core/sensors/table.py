"""The further sensors, by the names of their topics in topics.*."""

from collections.abc import Mapping

from bellows_ros.core.sensors.readings import Readings
from bellows_ros.core.sensors.weighing import Wrenches

SENSORS: Mapping[str, type[Readings]] = {'tool_wrench': Wrenches}
"""
Sensors by the roles of their topics.

The end of a role is the type of the messages: twist, wrench, or else poses.
"""
