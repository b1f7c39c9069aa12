"""Pictures, made with matplotlib (extra `plot`), and a view in Rerun (extra `view`)."""
