"""Reading data sets into one :class:`Sequence` type, cutting them into parts, and the built-in corridor world."""

from .errors import DatasetError, ImageError, SplitError
from .noise import PixelNoise
from .sequence import Sequence, read_image
from .sevenscenes import read_sevenscenes
from .splits import Split, SplitKind, make_split

__all__ = [
    "DatasetError",
    "ImageError",
    "PixelNoise",
    "Sequence",
    "Split",
    "SplitError",
    "SplitKind",
    "make_split",
    "read_image",
    "read_sevenscenes",
]
