"""The further sensors of a fit, by the names of their topics in topics.*: none."""

from collections.abc import Mapping

from bellows_ros.core.sensors.readings import Readings

SENSORS: Mapping[str, type[Readings]] = {}
"""Sensors by the roles of their topics."""
