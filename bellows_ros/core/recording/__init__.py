"""Preparation of recorded streams for identification."""
