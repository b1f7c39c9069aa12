"""Pictures, made with matplotlib (extra `plot`); nothing else in the package imports it."""
