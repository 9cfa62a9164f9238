"""Errors of the experiments floor."""

from __future__ import annotations

from conformodal.conformal import ConformodalError


class ExperimentError(ConformodalError):
    """An experiment whose parts do not fit together, or a baseline file that cannot be used."""
