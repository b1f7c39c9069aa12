"""Synthetic recordings: motions, and a model of the sensors."""
