"""Figures, the pages of results, and the live view."""
