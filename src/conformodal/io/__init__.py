"""Reading data sets into one :class:`Recording` type, and cutting them into parts.

Readers raise :class:`DatasetError`, which names the file, if something is missing or damaged, or does not fit.
"""

from conformodal.core.extras import require_extra

with require_extra("run", "reading images"):
    import cv2  # noqa: F401
    import PIL  # noqa: F401

from .check import check_recording
from .decoding import THUMBNAIL, read_image, thumbnail
from .disturbance import Disturbance, PixelNoise
from .errors import DatasetError, DatasetWarning, ImageError, SplitError
from .frame_table import FrameTable
from .recording import ImageChange, Recording
from .registry import Layout, Reader, read_recording, readers, recognise
from .splits import Split, SplitKind, held_out_together, make_split, with_random_calibration

__all__ = [
    "THUMBNAIL",
    "DatasetError",
    "DatasetWarning",
    "Disturbance",
    "FrameTable",
    "ImageChange",
    "ImageError",
    "Layout",
    "PixelNoise",
    "Reader",
    "Recording",
    "Split",
    "SplitError",
    "SplitKind",
    "check_recording",
    "held_out_together",
    "make_split",
    "read_image",
    "read_recording",
    "readers",
    "recognise",
    "thumbnail",
    "with_random_calibration",
]
