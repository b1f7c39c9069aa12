"""Predict and identify the motion of a package held by a bellows suction cup."""

__version__ = '0.1.0'
