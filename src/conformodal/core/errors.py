"""The root of every error this package raises on purpose."""

from __future__ import annotations


class ConformodalError(ValueError):
    """Invalid input: what was found, where, and what was expected.

    Examples
    --------
    >>> from conformodal import ConformodalError, conformal_rank
    >>> try:
    ...     conformal_rank(99, alpha=1.5)
    ... except ConformodalError as error:
    ...     print(error)
    alpha must lie strictly between 0 and 1 (a miscoverage rate), got 1.5; did you mean 0.015?
    """
