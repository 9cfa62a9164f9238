"""Settings of a map, and its errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from conformodal.core.errors import ConformodalError
from conformodal.core.extras import MissingPackageError, require_extra

NEEDED = ("global_mapping", "calibrate_view_graph", "match_image_pairs")  # since pycolmap 4.0.0


class MapError(ConformodalError):
    """Videos that no map can be made of, or scale or axes that cannot be found; says what to record instead."""


@dataclass(frozen=True)
class MapSettings:
    """How a map is made; pixels are those of images whose longer side has 640, unless another is said."""

    keyframe_flow_px: float = 26.0  # usual motion of corners from one keyframe to the next
    max_keyframes: int = 600  # of all videos; where there are more, some are passed over evenly
    feature_side_px: int = 1600  # longer side of the images that features are found in
    max_features: int = 2048  # per image
    neighbours: tuple[int, ...] = (1, 2, 3, 4, 6, 8, 12)  # keyframes later in the same video that one is matched with
    retrieved: int = 6  # similar keyframes elsewhere that one is matched with
    min_matches: int = 15  # of a pair, after its epipolar geometry is verified
    jpeg_quality: int = 95  # of frames of videos
    seed: int = 0
    trust_map: bool = False  # write a map although it is not to be trusted


def require_pycolmap() -> Any:
    """The module pycolmap, quiet; a MissingPackageError where it is missing or has no global mapper."""
    with require_extra("colmap", "mapping a video"):
        import pycolmap  # noqa: PLC0415 - an extra
    if missing := [name for name in NEEDED if not hasattr(pycolmap, name)]:
        found = f"pycolmap {pycolmap.__version__} has no {missing[0]}"
        raise MissingPackageError(
            f"mapping a video needs pycolmap 4 or newer, {found}: pip install 'conformodal[colmap]'"
        )
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)  # its failures come as exceptions or empty results
    return pycolmap
