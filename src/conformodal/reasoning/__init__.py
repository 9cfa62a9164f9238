"""Choosing among candidate poses with the help of relative motion. NumPy and SciPy only.

A reasoner is a function from :class:`Observations` and a :class:`MotionPrior` to a :class:`PosePath`: :func:`viterbi`,
:func:`online`. :func:`smooth` makes any path finer. :class:`Greedy` is the paper's reasoning.
"""
