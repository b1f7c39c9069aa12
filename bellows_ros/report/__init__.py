"""
Reports: self-contained HTML files, without network or scripts, with the pictures of `plots`.

The same numbers give the same bytes: nothing in a page depends on when or where it was made.
"""
