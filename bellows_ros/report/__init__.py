"""
Reports: one HTML file with everything in it, which needs no network, no scripts and no plotting.

The same numbers give the same bytes: nothing in a page depends on when or where it was made.
"""
