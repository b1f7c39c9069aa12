"""Recorded motions: trajectories, resampling, the Savitzky-Golay filter, residuals."""
