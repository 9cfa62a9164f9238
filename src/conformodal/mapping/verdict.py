"""Whether a map is to be trusted: what is measured of it, the limits, and what to record instead."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np

from conformodal.core.arrays import FloatArray
from conformodal.core.words import counted, listed
from conformodal.geometry import PinholeCamera
from conformodal.geometry.lens import on_plane
from conformodal.io.diagnosis.images import FITS, NEAR_PX, Motions, as_rays, epipolar_px

from .clips import Clip
from .keyframes import SIDE_PX
from .matching import VerifiedPair
from .structure import Structure, pinhole, reprojection_errors

_MIN_REGISTERED, _MIN_CLIP = 0.8, 0.5  # shares of all frames, and of those of one video
_MIN_AGREEING = 0.8  # share of the pairs
_MIN_KEYFRAMES, _MIN_VIEWS, _MAX_ERROR_PX, _MIN_ANGLE_DEG = 5, 3.0, 2.0, 2.0


class Reason(NamedTuple):
    """Why a map is not to be trusted, and what to record instead."""

    what: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.what}; {self.remedy}"


@dataclass(frozen=True)
class MapQuality:
    """What is measured of a map; pixels are those of images whose longer side has 640."""

    n_frames: int
    n_registered: int
    registered_by_clip: dict[str, float]  # share of the frames of each video, by its source
    n_keyframes: int
    n_mapped: int  # keyframes in the largest piece
    n_pieces: int
    reprojection_px: float  # mean over the points
    views_per_point: float
    angle_deg: float  # median over the points, of the largest angle between two of their rays
    n_pairs: int  # of keyframes in the map, whose matches are verified
    agreeing: float  # share of these whose matches lie near the epipolar lines of the map
    n_loops: int  # agreeing pairs of keyframes that are not neighbours in one video
    n_loops_tried: int  # of all such pairs with verified matches

    @property
    def n_clips(self) -> int:
        """Videos that are mapped together."""
        return len(self.registered_by_clip)

    @property
    def registered(self) -> float:
        """Share of all frames that have a pose."""
        return self.n_registered / self.n_frames

    def record(self) -> dict[str, Any]:
        """As JSON has it."""
        return {key: round(value, 4) if isinstance(value, float) else value for key, value in asdict(self).items()}

    def lines(self) -> list[str]:
        """For people."""
        return [
            f"registered: {self.n_registered} of {counted(self.n_frames, 'frame')} ({100 * self.registered:.0f} %), "
            f"{self.n_mapped} of {counted(self.n_keyframes, 'keyframe')}, in {counted(self.n_pieces, 'piece')}",
            f"reprojection error: {self.reprojection_px:.2f} px at {SIDE_PX} px; {self.views_per_point:.1f} views per "
            f"point, from {self.angle_deg:.1f} degrees",
            f"epipolar geometry: {100 * self.agreeing:.0f} % of {counted(self.n_pairs, 'pair')} agree; "
            f"{self.n_loops} of {counted(self.n_loops_tried, 'loop')} closed",
        ]


def measure_map(
    clips: Sequence[Clip], structure: Structure, poses: Mapping[str, FloatArray], pairs: Sequence[VerifiedPair]
) -> MapQuality:
    """Measure a map; `poses` are those of all registered frames, in the map."""
    model = structure.model
    shares = {clip.source: float(np.mean([image in poses for image in clip.images])) for clip in clips}
    cameras = {image.name: pinhole(model.cameras[image.camera_id]) for image in model.images.values()}
    inside = [pair for pair in pairs if pair.first in structure.pieces[0] and pair.second in structure.pieces[0]]
    agree = np.array([_agrees(pair, poses, cameras[pair.first], cameras[pair.second]) for pair in inside], dtype=bool)
    loops = np.array([not pair.near for pair in inside], dtype=bool)
    return MapQuality(
        n_frames=sum(map(len, clips)),
        n_registered=len(poses),
        registered_by_clip=shares,
        n_keyframes=sum(len(clip.keyframes) for clip in clips),
        n_mapped=len(structure.pieces[0]),
        n_pieces=len(structure.pieces),
        reprojection_px=mean_error_px(model),
        views_per_point=float(model.compute_mean_track_length()),
        angle_deg=_usual_angle_deg(model),
        n_pairs=len(inside),
        agreeing=float(agree.mean()) if len(agree) else 0.0,
        n_loops=int((agree & loops).sum()),
        n_loops_tried=int(loops.sum()),
    )


def _agrees(pair: VerifiedPair, poses: Mapping[str, FloatArray], first: PinholeCamera, second: PinholeCamera) -> bool:
    """Whether the matches of a pair lie near the epipolar lines of its poses, as `data check` asks of recordings."""
    T_second_first = np.linalg.inv(poses[pair.second]) @ poses[pair.first]
    motions = Motions(T_second_first[None, :3, :3], T_second_first[None, :3, 3])
    planes = [on_plane(camera, pair.pixels[:, k]) for k, camera in enumerate((first, second))]
    errors = epipolar_px(motions, as_rays(np.stack(planes, axis=1))[None], first.fx)
    near = NEAR_PX * max(1.0, max(first.width, first.height) / SIDE_PX)
    return bool(np.mean(errors < near) >= FITS)


def mean_error_px(model: Any) -> float:
    """Mean over the points of their mean errors, as COLMAP has it, but each error at the size of its own image."""
    points, errors = list[int](), list[float]()
    for image, _, px in reprojection_errors(model):
        points += [point.point3D_id for point in image.get_observation_points2D()]
        errors += (px * SIDE_PX / max(image.camera.width, image.camera.height)).tolist()
    _, which = np.unique(points, return_inverse=True)
    return float((np.bincount(which, errors) / np.bincount(which)).mean()) if errors else 0.0


def _usual_angle_deg(model: Any) -> float:
    """Median over the points of the largest angle between their rays."""
    centres = {key: image.projection_center() for key, image in model.images.items() if image.has_pose}
    angles = []
    for point in model.points3D.values():
        seen = [element.image_id for element in point.track.elements]
        rays = np.array([centres[key] - point.xyz for key in seen])
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
        angles.append(float(np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1.0, 1.0)))))
    return float(np.median(angles)) if angles else 0.0


def judge(quality: MapQuality) -> list[Reason]:
    """Why a map is not to be trusted; empty where it is."""
    reasons = list[Reason]()
    alone = [source for source, share in quality.registered_by_clip.items() if share < _MIN_CLIP]
    if quality.n_mapped < _MIN_KEYFRAMES:
        reasons.append(
            Reason(
                f"{counted(quality.n_mapped, 'keyframe')} could be joined, expected {_MIN_KEYFRAMES} or more",
                "record longer, walking around what is to be mapped",
            )
        )
    if alone and len(alone) < len(quality.registered_by_clip):
        reasons.append(
            Reason(
                f"{listed(alone)} {'do' if len(alone) > 1 else 'does'} not connect to the others",
                "record it again from a view of the others on, or leave it out",
            )
        )
    elif quality.registered < _MIN_REGISTERED:
        reasons.append(
            Reason(
                f"{100 * quality.registered:.0f} % of the frames have a place in the map, expected "
                f"{100 * _MIN_REGISTERED:.0f} %",
                "record in one go, more slowly, without quick turns, and with more light",
            )
        )
    if quality.agreeing < _MIN_AGREEING:
        reasons.append(
            Reason(
                f"{100 * quality.agreeing:.0f} % of the pairs of keyframes agree with the map, expected "
                f"{100 * _MIN_AGREEING:.0f} %: it is bent, or joins places that only look alike",
                "record more slowly, return to places that were seen before, and show what tells alike places apart",
            )
        )
    if quality.reprojection_px > _MAX_ERROR_PX:
        reasons.append(
            Reason(
                f"the reprojection error is {quality.reprojection_px:.1f} px, expected at most {_MAX_ERROR_PX:g}",
                "record with a fixed focus and without electronic stabilisation",
            )
        )
    if quality.views_per_point < _MIN_VIEWS or quality.angle_deg < _MIN_ANGLE_DEG:
        reasons.append(
            Reason(
                f"points have {quality.views_per_point:.1f} views, from {quality.angle_deg:.1f} degrees, expected "
                f"{_MIN_VIEWS:g} and {_MIN_ANGLE_DEG:g}",
                "move the camera sideways instead of turning it on the spot",
            )
        )
    return reasons
