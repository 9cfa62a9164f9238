"""By how much an image is turned before local features are looked for that do not turn with the camera.

XFeat recognises no place whose keyframes are rolled by more than some 45 degrees against the image. Where the camera
was recognised before, and its rotation followed since, its roll is known well enough to turn the next image.
"""

from __future__ import annotations

from collections.abc import Sequence

from scipy.spatial.transform import Rotation

from conformodal.core.arrays import FloatArray
from conformodal.geometry import RelativeMotion
from conformodal.geometry.poses import trusted_rotation

from .evidence import PoseMeasurement
from .localizer import Localizer, recognised_only

# Frames in a row without a recognised place, after which every second one is looked at upright: the rotation that was
# followed may be wrong by then; and after which it is forgotten
_TRUSTED_FRAMES, _REMEMBERED_FRAMES = 5, 60


class TurnTracker:
    """Dead reckoning of the camera's rotation from the last recognised place, frame by frame of one recording.

    As in the filter, poses are taken for the camera's own: a mount that turns little changes a roll little.
    """

    def __init__(self, localizer: Localizer) -> None:
        self._localizer = localizer
        self.reset()

    def reset(self) -> None:
        """Start a new recording."""
        self._position_xyz: FloatArray | None = None
        self._rotation = Rotation.identity()
        self._unrecognised = 0  # frames in a row

    def advance(self, motion: RelativeMotion | None) -> None:
        """Go on to the next image, `motion` after the one before."""
        if self._position_xyz is not None and motion is not None and motion.R_prev_next is not None:
            self._rotation = self._rotation * trusted_rotation(motion.R_prev_next)

    @property
    def turn_rad(self) -> float:
        """The angle in radians by which to turn the current image."""
        if self._position_xyz is None:
            return 0.0
        if self._unrecognised > _TRUSTED_FRAMES and self._unrecognised % 2:
            return 0.0
        return self._localizer.turn_for(self._position_xyz, self._rotation.as_quat(scalar_first=True))

    def observe(self, estimates: Sequence[PoseMeasurement]) -> None:
        """Take the estimates of that image: a recognised place is where dead reckoning starts again."""
        recognised = recognised_only(estimates)
        self._unrecognised += 1
        if self._unrecognised > _REMEMBERED_FRAMES:
            self._position_xyz = None
        if recognised:
            best = max(recognised, key=lambda one: one.inlier_probability)
            self._position_xyz, self._unrecognised = best.position_xyz, 0
            self._rotation = Rotation.from_quat(best.orientation_quat_wxyz, scalar_first=True)
