"""Reading data sets into one :class:`Sequence` type, cutting them into parts, and the built-in corridor world.

Readers raise :class:`DatasetError`, which names the file, if something is missing or damaged, or does not fit.
"""

from conformodal.core.extras import require_extra

with require_extra("run", "reading images"):
    import cv2  # noqa: F401
    import PIL  # noqa: F401

from .checking import DatasetCheck, Finding, check_sequence
from .colmap import read_colmap
from .decoding import THUMBNAIL, read_image, thumbnail
from .disturbance import Disturbance
from .errors import DatasetError, DatasetWarning, ImageError, SplitError
from .euroc import read_euroc_mav
from .images import read_image_folder
from .kitti import read_kitti_odometry
from .layouts import Layout, read_sequence, recognise
from .nerf import read_nerf
from .reading import Note
from .rgbd_scenes import read_rgbd_scenes
from .sequence import ImageChange, PixelNoise, Sequence
from .sevenscenes import read_sevenscenes
from .splits import Split, SplitKind, frames_to_known, held_out_together, make_split, with_random_calibration
from .tum import read_tum_rgbd

__all__ = [
    "THUMBNAIL",
    "DatasetCheck",
    "DatasetError",
    "DatasetWarning",
    "Disturbance",
    "Finding",
    "ImageChange",
    "ImageError",
    "Layout",
    "Note",
    "PixelNoise",
    "Sequence",
    "Split",
    "SplitError",
    "SplitKind",
    "check_sequence",
    "frames_to_known",
    "held_out_together",
    "make_split",
    "read_colmap",
    "read_euroc_mav",
    "read_image",
    "read_image_folder",
    "read_kitti_odometry",
    "read_nerf",
    "read_rgbd_scenes",
    "read_sequence",
    "read_sevenscenes",
    "read_tum_rgbd",
    "recognise",
    "thumbnail",
    "with_random_calibration",
]
