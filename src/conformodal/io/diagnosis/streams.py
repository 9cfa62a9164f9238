"""Doubts about the images of a stream: red and blue swapped."""

from __future__ import annotations

import numpy as np

from conformodal.core.arrays import FloatArray

_SWAPPED = 0.2  # by how much the colours fit better with red and blue swapped


def doubt_colours(colours: FloatArray, expected: FloatArray) -> str:
    """Whether the colours of images are those of training with red and blue swapped; nothing where they are not.

    Both are shares (b,) of pixels by red less blue, whose order the swap turns round.
    """
    as_given, swapped = (float(np.minimum(one, expected).sum()) for one in (colours, colours[::-1]))
    if swapped <= as_given + _SWAPPED:
        return ""
    return (
        f"images seem to be BGR: their colours agree with those of the training data to {100 * as_given:.0f} %, with "
        f"red and blue swapped to {100 * swapped:.0f} %; pass RGB"
    )
