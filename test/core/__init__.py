"""Tests of bellows_ros.core."""
