"""Fits on wrenches: linear in K and P."""
