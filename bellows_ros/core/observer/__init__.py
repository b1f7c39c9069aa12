"""Correct the prediction with measured poses of the package."""
