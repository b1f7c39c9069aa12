"""
Reports: self-contained HTML files, without network, scripts or plotting library.

The same numbers give the same bytes: nothing in a page depends on when or where it was made.
"""
