"""Recordings that never were: motions, and what sensors make of them."""
