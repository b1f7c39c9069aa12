"""Tests of bellows_ros.bench."""
