"""Tests of the pages: commands, links and generated parts."""
