"""Readers, one file per layout."""
