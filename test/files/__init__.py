"""Tests of bellows_ros.files."""
