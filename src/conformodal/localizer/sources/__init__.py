"""Pose sources: a network head, and landmarks."""
