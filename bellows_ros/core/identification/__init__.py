"""Identification of a cup's stiffness K and damping P from prepared recordings."""
