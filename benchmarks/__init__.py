"""Measurements of speed and accuracy that the documentation quotes: `make bench`."""
