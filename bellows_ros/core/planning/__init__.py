"""Planned motions: prediction, steering without swing, the shortest time, limits, arms."""
