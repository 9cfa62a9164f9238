"""Doubts about input that can be read: what is likely wrong with it, by which evidence, and what to do."""
