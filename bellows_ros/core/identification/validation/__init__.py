"""Fits held against other recordings, and against each other."""
