"""Files in, core types out: recordings, parameter files and results."""
