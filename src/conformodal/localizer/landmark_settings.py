"""Settings of maps of landmarks and of localisation in them.

Commands use the defaults. A model does not store them: once loaded, it localises with the defaults.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class LandmarkMapSettings:
    """How frames with known poses become landmarks."""

    max_landmarks: int = 300  # of a frame
    # strongest corners of a frame; the others are triangulated where these give too few landmarks
    tried_first: int = 450
    max_tracked: int = 200  # corners of a frame that are triangulated to adjust poses: those that most frames see
    rounds: int = 2  # of triangulation and adjustment; standard deviations and mount are learnt after each
    frames_at_a_time: int = 32  # that are triangulated
    partners: int = 10  # frames in which a frame's corners are sought; pairs serve both
    max_turned_rad: float = float(np.radians(35.0))  # between the axes of partners
    usual_turn_rad: float = float(np.radians(15.0))  # which counts as much as e times the best distance
    nearest_depths: float = 0.02  # of partners, in scene depths: nearer ones give no parallax
    best_depths: float = 0.15
    farthest_depths: float = 0.8  # farther ones see other things
    tolerance_px: float = 4.0  # of a ray
    matches_per_pair: int = 40  # that the camera is fitted with
    min_sigma: float = 5e-4  # of given poses that join a map, in radians and scene depths


@dataclass(frozen=True)
class PoseSettings:
    """How an image is localised: retrieval, PnP and guided matching."""

    n_retrieved: int = 200  # most similar keyframes, which are clustered by position
    max_clusters: int = 8
    n_first: int = 6  # keyframes that are matched in the most similar cluster
    n_others: int = 3  # and in each of the others
    spread: float = 0.05  # scene depths plus radians by which these differ; 0.1 makes poses worse on fr1
    radius_depths: float = 0.5  # of a cluster
    max_distance_ratio: float = 5.0  # descriptor distance of a cluster over that of the first
    # matches of a keyframe, and their share, that agree with a pose by more than chance: in other places none do
    min_agreeing: int = 6
    min_agreeing_share: float = 0.1
    max_reprojection_px: float = 6.0  # of an inlier
    max_samples: int = 300
    max_samples_of_rival: int = 60  # half of the matches of a place that rivals a sure one would be right
    # guided matching looks for landmarks of keyframes near a pose where the pose projects them
    min_guiding_inliers: int = 30  # of that pose; wrong ones have fewer
    n_considered: int = 100  # keyframes nearest to it
    n_guiding: int = 6  # keyframes among these whose landmarks are looked for
    radius_px: float = 8.0  # in which corners are compared with a landmark
    n_corners: int = 4  # nearest ones that are
    min_residual_px: float = 0.5  # corners are not located more precisely
    n_corrected_by: int = 6  # nearest keyframes, whose deviations correct an estimate
    min_distance: float = 0.01  # scene depths plus radians, added to their distances, whose inverses are the weights
    n_rolls: int = 10  # keyframes near an expected pose whose rolls are compared
    matched_roll_rad: float = float(np.radians(30.0))  # up to which XFeat matches as well as upright


@dataclass(frozen=True)
class LandmarkSettings:
    """Which frames become keyframes, and which of these the errors are learnt from."""

    # From a keyframe to the next, in scene depths plus radians: views in between add nothing. With 0.015 to 0.04, a
    # half to a fifth of the frames of redkitchen, poses by SfM are a tenth better in the median than with all frames
    # (blocks, seeds 20 to 22) and as good (interleaved, seeds 20, 21); by KinectFusion's poses they get worse from 0.04
    # on
    keyframe_step: float = 0.025
    max_keyframes: int = 1000  # of an area of this radius
    area_depths: float = 5.0
    n_left_out: int = 100  # keyframes that the errors are learnt from
    # Keyframes whose view overlaps by more than this are hidden from a left-out one, so that hardly anything it sees is
    # mapped; and the weight of such a case
    hidden_overlaps: tuple[float, ...] = (0.0, 0.3)
    hidden_weight: float = 0.05
    same_place_depths: float = 0.5  # within which an estimate is of the same place
    mapping: LandmarkMapSettings = LandmarkMapSettings()
    pose: PoseSettings = PoseSettings()
