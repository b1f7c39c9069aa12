"""The suite, laid out as the package is; shared fixtures stand in conftest.py."""
