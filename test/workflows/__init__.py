"""Tests of bellows_ros.workflows."""
