"""The table of parameters, checks of their values, and nested settings."""
