"""Tests of the package that colcon installed."""
