"""The root of every error this package raises on purpose."""

from __future__ import annotations


class ConformodalError(ValueError):
    """Bad input, told kindly: what was found, where, and what was expected.

    Every package has an error of its own below it. For an example see :class:`~conformodal.conformal.ConformalError`.
    """
