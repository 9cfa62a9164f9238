"""Doubts about input that can be read: what is likely wrong with it, by which evidence, and what to do.

Causes are looked for in an order, from the cheapest on, and the one that explains the data is told: see :mod:`order`.
"""
