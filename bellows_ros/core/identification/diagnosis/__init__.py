"""Diagnosis of recordings and of given quantities."""
