"""Tests of bellows_ros.nodes."""
