"""Identification from standstills: the nominal length, and K alone."""
