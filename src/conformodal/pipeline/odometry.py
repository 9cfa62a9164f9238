"""What both systems share: they answer a stream frame by frame, or a whole sequence."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
import numpy.typing as npt

from conformodal.core.arrays import Float32Array, IntArray, UInt8Array
from conformodal.core.parallel import one_blas_thread
from conformodal.core.progress import StageProgress, stage_of
from conformodal.features.extract import FeatureCache, extract_features
from conformodal.geometry import Trajectory
from conformodal.io import Recording
from conformodal.tracking.frontend import FrontEnd
from conformodal.tracking.motions import MotionRecord

from .errors import OdometryError
from .estimates import Estimate, OdometryRun
from .frame import as_frames, as_image, as_time
from .model import PoseModel


class Odometry(ABC):
    """A trained model on a stream or on a sequence: :class:`VisualOdometry`, or the paper's :class:`PaperOdometry`.

    Attributes
    ----------
    model
        Trained and calibrated.
    answer
        The method whose trajectory is the answer.
    whole_paths
        Whether better answers than those of a stream follow, from whole paths.
    lag
        Frames of a stream whose answer may still change.
    """

    model: PoseModel
    answer: str
    whole_paths: bool
    lag: int
    _front_end: FrontEnd
    _seen_s: float | None  # of the last frame, usable or not
    _shown_s: float | None  # of the last usable one

    @abstractmethod
    def reset(self) -> None:
        """Forget the stream so far."""

    def step(self, image: npt.ArrayLike | None, timestamp_s: float) -> Estimate:
        """Take the next frame of a stream, (height, width, 3) RGB, or None where the camera gave none.

        The pose is the best given all frames so far, and `revised` those before it, better known by now;
        :meth:`run` also uses the frames after. A frame that cannot be used does not end the stream: the estimate says
        so.

        Raises
        ------
        OdometryError
            If the timestamp is not finite, or not later than that of the frame before, usable or not; nothing has
            changed then.
        """
        timestamp_s = as_time(timestamp_s, self._seen_s)
        usable = as_image(image, self.model.camera)
        if isinstance(usable, str):
            estimate = Estimate(timestamp_s, None, None, None, None, False, usable)
        else:
            with one_blas_thread():
                estimate = self._answer(usable, timestamp_s)
            self._shown_s = timestamp_s
        self._seen_s = timestamp_s
        return estimate

    @abstractmethod
    def _answer(self, image: UInt8Array, timestamp_s: float) -> Estimate:
        """The estimate of a frame that can be used; its time becomes the last one."""

    def track_only(self, image: npt.ArrayLike | None, timestamp_s: float) -> None:
        """Show a frame of the stream that wants no answer: corners are followed through it, if it is an image.

        Raises
        ------
        OdometryError
            As in :meth:`step`.
        """
        timestamp_s = as_time(timestamp_s, self._seen_s)
        found = as_image(image, self.model.camera)
        if not isinstance(found, str):
            self._front_end.track_only(found)
            self._shown_s = timestamp_s
        self._seen_s = timestamp_s

    def run(self, sequence: Recording) -> Trajectory:
        """The trajectory of a whole sequence; :meth:`process` gives all the rest."""
        return self.process(sequence).trajectory

    def process(
        self,
        sequence: Recording,
        frames: IntArray | None = None,
        *,
        cache: FeatureCache | None = None,
        motions: MotionRecord | None = None,
        progress: StageProgress | None = None,
    ) -> OdometryRun:
        """Work out regions and trajectories of a sequence.

        Parameters
        ----------
        sequence
            Frames in order of time, of the model's camera.
        frames
            Frames to answer, increasing; all by default. The network sees these only. The tracker also follows
            corners through the frames between them, as a camera would deliver them.
        cache
            Of features.
        motions
            From :meth:`measure_motions` on the same frames, if they are known already.
        progress
            Called with stage, frames done and frames in all.

        Raises
        ------
        OdometryError
            If no frame can be read, the camera is another one, or `frames` are not increasing indices of frames.
        """
        self.model.check_camera(sequence.camera)
        wanted = np.arange(len(sequence)) if frames is None else as_frames(frames, len(sequence))
        if motions is None:
            motions = self.measure_motions(sequence, wanted, progress)
        usable = np.array([i for i in wanted.tolist() if i in motions.motions], dtype=np.int64)
        if usable.size == 0:
            raise OdometryError(f"{sequence.name}: none of {wanted.size} frames can be read: {motions.unreadable}")
        features = extract_features(
            [sequence.image_paths[i] for i in usable],
            self.model.backbone,
            cache or FeatureCache(None),
            stage_of(progress, "network"),
            sequence.noise,
        )
        return self._answered(sequence, usable, features, motions)

    @abstractmethod
    def measure_motions(
        self, sequence: Recording, frames: IntArray, progress: StageProgress | None = None
    ) -> MotionRecord:
        """Measure `frames`, see :func:`~conformodal.tracking.motions.measure_motions`."""

    @abstractmethod
    def _answered(
        self, sequence: Recording, frames: IntArray, features: Float32Array, motions: MotionRecord
    ) -> OdometryRun:
        """Regions and trajectories of frames (m,) that can be read, from their features (m, F) and motions."""
