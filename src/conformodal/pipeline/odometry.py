"""What every method has: it answers a stream frame by frame (:meth:`Odometry.step`), or a whole recording."""

from __future__ import annotations

import math
import warnings
from abc import ABC, abstractmethod
from contextlib import closing
from typing import Any

import numpy as np
import numpy.typing as npt

from conformodal.core.arrays import FloatArray, IntArray, UInt8Array
from conformodal.core.parallel import one_blas_thread, raise_if_cancelled
from conformodal.core.progress import StageProgress
from conformodal.geometry import PinholeCamera
from conformodal.io import Recording
from conformodal.io.diagnosis.clocks import doubt_steps
from conformodal.io.diagnosis.streams import doubt_colours
from conformodal.io.streams.frames import RecordingStream, prefetch
from conformodal.localizer.regions import PoseRegions
from conformodal.tracking.tracker import FrontEnd

from .config import OdometryError
from .estimates import Estimate, OdometryRun
from .model import HINDSIGHT, ONLINE, ExpectedInput, PoseModel, colours_of
from .stream import StreamRunner

_FIRST = 10  # frames of a stream whose times and colours are looked at


class InputWatch:
    """Looks at the first frames of a stream, whether its times are in seconds and its images RGB."""

    def __init__(self, expected: ExpectedInput) -> None:
        self._expected = expected
        self._steps: list[float] = []
        self._colours: list[FloatArray] = []

    def check_step(self, step_s: float) -> None:
        """Refuse, once the first steps are there, times that are in another unit."""
        if len(self._steps) >= _FIRST:
            return
        self._steps.append(step_s)
        if len(self._steps) == _FIRST and (doubt := doubt_steps(self._steps, self._expected.step_s)):
            self._steps.pop()  # so that the next step is looked at as well
            raise OdometryError(doubt)

    def check_colours(self, image: UInt8Array) -> None:
        """Warn, once, of images (h, w, 3) whose red and blue are swapped."""
        if len(self._colours) >= _FIRST:
            return
        self._colours.append(colours_of(image))
        if len(self._colours) < _FIRST:
            return
        if doubt := doubt_colours(np.mean(self._colours, axis=0), self._expected.colours):
            warnings.warn(doubt, UserWarning, stacklevel=5)


class Odometry(ABC):
    """A trained model on a stream or on a recording: :class:`VisualOdometry`, or the paper's."""

    model: PoseModel
    answer: str  # the method whose trajectory is the answer
    whole_paths: bool  # whether better answers than those of a stream follow, from whole paths
    _front_end: FrontEnd
    _watch: InputWatch
    _last_s: float | None  # of the last frame, usable or not
    _usable_s: float | None  # of the last usable one

    @abstractmethod
    def __init__(self, model: PoseModel) -> None:
        """From a trained model of the method."""

    @abstractmethod
    def reset(self) -> None:
        """Forget the stream so far."""

    def step(self, image: npt.ArrayLike | None, timestamp_s: float) -> Estimate:
        """Take the next frame of a stream, (height, width, 3) RGB, or None where the camera gave none.

        The pose is the best given all frames so far, and `revised` those before it, better known by now;
        :meth:`process` also uses the frames after. A frame that cannot be used does not end the stream: the estimate
        says so.

        Raises
        ------
        OdometryError
            If the timestamp is not finite, or not later than that of the frame before, usable or not, or if the first
            ten steps are far too long for seconds; nothing has changed then.
        """
        timestamp_s = self._next_time(timestamp_s)
        usable = _as_image(image, self.model.camera)
        if isinstance(usable, str):
            estimate = Estimate(timestamp_s, problem=usable)
        else:
            self._watch.check_colours(usable)
            with one_blas_thread():
                estimate = self._answer(usable, timestamp_s)
            self._usable_s = timestamp_s
        self._last_s = timestamp_s
        return estimate

    def _next_time(self, timestamp_s: Any) -> float:
        """A timestamp in seconds, later than the last one."""
        seconds = _as_time(timestamp_s, self._last_s)
        if self._last_s is not None:
            self._watch.check_step(seconds - self._last_s)
        return seconds

    @abstractmethod
    def _answer(self, image: UInt8Array, timestamp_s: float) -> Estimate:
        """The estimate of a frame that can be used; its time becomes the last one."""

    def track_only(self, image: npt.ArrayLike | None, timestamp_s: float) -> None:
        """Show a frame of the stream that wants no answer: corners are followed through it, if it is an image."""
        timestamp_s = self._next_time(timestamp_s)
        usable = _as_image(image, self.model.camera)
        if not isinstance(usable, str):
            self._front_end.track_only(usable)
            self._usable_s = timestamp_s
        self._last_s = timestamp_s

    def process(
        self, sequence: Recording, frames: npt.ArrayLike | None = None, *, progress: StageProgress | None = None
    ) -> OdometryRun:
        """Answer a recording of the model's camera as a stream that ends, apart from the stream of this object.

        `frames` are those to answer, increasing; all by default. The tracker also follows corners through the frames
        between them, as a camera would deliver them. `progress` is called with stage, frames done and frames in all.

        Raises
        ------
        OdometryError
            If no frame can be read, the camera is another one, or `frames` are not increasing indices of frames.
        """
        self.model.check_camera(sequence.camera)
        wanted = np.arange(len(sequence)) if frames is None else _as_frames(frames, len(sequence))
        stream, unreadable = RecordingStream(sequence, wanted), dict[int, str]()
        answers: dict[int, Estimate] = {}
        with StreamRunner(type(self)(self.model), keep_regions=True) as runner, closing(prefetch(stream)) as coming:
            for done, frame in enumerate(coming, start=1):
                raise_if_cancelled()
                estimate = runner.push(frame)
                if estimate is not None and estimate.region is None:
                    unreadable[frame.index] = frame.problem or estimate.problem
                elif estimate is not None:
                    answers[frame.index] = estimate
                if progress is not None:
                    progress("frames", done, stream.n_frames)
            runner.finish()
        if not answers:
            raise OdometryError(f"{sequence.name}: none of {wanted.size} frames can be read: {unreadable}")
        answered, estimates = np.array(list(answers)), list(answers.values())
        online = [e.path_region for e in estimates if e.path_region is not None]
        regions = {ONLINE: online, HINDSIGHT: runner.hindsight_regions}
        return OdometryRun(
            model=self.model,
            frames=answered,
            recording=sequence.recording[answered],
            estimates=estimates,
            trajectories=runner.trajectories,
            answer=self.answer,
            unreadable=unreadable,
            path_regions={path: PoseRegions.concatenate(parts) for path, parts in regions.items() if parts},
        )


def _as_image(image: Any, camera: PinholeCamera) -> UInt8Array | str:
    """An image (height, width, 3) in the camera's size, RGB, 8 bits, contiguous; or, as text, why it is not one.

    It may be what NumPy makes an array of, such as a Pillow image.
    """
    if image is None:
        return "no image"
    expected = (camera.height, camera.width, 3)
    try:
        pixels = np.asarray(image)
    except Exception as exc:  # whatever the object raises: it is not an image, and the stream goes on
        return f"image is a {type(image).__name__} that is not an array ({type(exc).__name__}: {exc})"
    if np.ma.is_masked(image):
        return "image is masked, expected all pixels"
    if pixels.shape != expected or pixels.dtype != np.uint8:
        return f"image is {pixels.dtype} {pixels.shape}, expected uint8 {expected}"
    return np.ascontiguousarray(pixels)  # flipped views too: others read its memory


def _as_time(timestamp_s: Any, last_s: float | None) -> float:
    """A timestamp in seconds, later than the last one."""
    try:
        seconds = float(timestamp_s)
    except (TypeError, ValueError, OverflowError):
        raise OdometryError(f"timestamp must be a number of seconds, got {timestamp_s!r}") from None
    if not math.isfinite(seconds):
        raise OdometryError(f"timestamp must be finite, got {seconds} s")
    if last_s is not None and not seconds > last_s:
        raise OdometryError(f"timestamps must increase: {seconds} s follows {last_s} s")
    return seconds


def _as_frames(frames: npt.ArrayLike, n: int) -> IntArray:
    """Increasing indices (m,) of some of n frames."""
    wanted = np.asarray(frames)
    whole = wanted.ndim == 1 and (not wanted.size or wanted.dtype.kind in "iu")
    if not whole or not np.isin(wanted, np.arange(n)).all() or (np.diff(wanted) <= 0).any():
        raise OdometryError(f"frames must be increasing whole numbers within 0 and {n - 1}, got {frames!r}")
    return wanted.astype(np.int64)
