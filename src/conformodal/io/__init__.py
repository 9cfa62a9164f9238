"""Reading data sets into one :class:`Recording` type, cutting them into parts, and the built-in corridor world.

Readers raise :class:`DatasetError`, which names the file, if something is missing or damaged, or does not fit.
"""

from conformodal.core.extras import require_extra

with require_extra("run", "reading images"):
    import cv2  # noqa: F401
    import PIL  # noqa: F401

from .check import DatasetCheck, Finding, check_recording
from .decoding import THUMBNAIL, read_image, thumbnail
from .disturbance import Disturbance
from .errors import DatasetError, DatasetWarning, ImageError, SplitError
from .layouts.colmap import read_colmap
from .layouts.euroc import read_euroc_mav
from .layouts.images import read_image_folder
from .layouts.kitti import read_kitti_odometry
from .layouts.nerf import read_nerf
from .layouts.rgbd_scenes import read_rgbd_scenes
from .layouts.sevenscenes import read_sevenscenes
from .layouts.tum import read_tum_rgbd
from .reading import Note
from .recording import ImageChange, PixelNoise, Recording
from .registry import Layout, read_recording, recognise
from .splits import Split, SplitKind, frames_to_known, held_out_together, make_split, with_random_calibration

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
    "Recording",
    "Split",
    "SplitError",
    "SplitKind",
    "check_recording",
    "frames_to_known",
    "held_out_together",
    "make_split",
    "read_colmap",
    "read_euroc_mav",
    "read_image",
    "read_image_folder",
    "read_kitti_odometry",
    "read_nerf",
    "read_recording",
    "read_rgbd_scenes",
    "read_sevenscenes",
    "read_tum_rgbd",
    "recognise",
    "thumbnail",
    "with_random_calibration",
]
