"""Tests of the command `bellows`, driven as a user does."""
