"""The estimator: from frames to regions, places and a trajectory. Only :meth:`Odometry.step` answers a frame."""

from __future__ import annotations

import math
import warnings
from abc import ABC, abstractmethod
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from conformodal.core.arrays import FloatArray, IntArray, UInt8Array
from conformodal.core.parallel import one_blas_thread, raise_if_cancelled
from conformodal.core.progress import StageProgress
from conformodal.features.local import LocalFeatures, extract_local_features
from conformodal.geometry import PinholeCamera, RelativeMotion, Trajectory
from conformodal.geometry.camera import NO_FLOW
from conformodal.io import Recording
from conformodal.io.decoding import grey_image
from conformodal.io.diagnosis.clocks import doubt_steps
from conformodal.io.diagnosis.streams import doubt_colours
from conformodal.io.streams.frames import RecordingStream, prefetch
from conformodal.localizer.candidates import pose_targets
from conformodal.localizer.carrying import FrameLook, FrameStream, StreamFrame
from conformodal.localizer.evidence import FrameEvidence
from conformodal.localizer.filter import PoseFilter, Window, hindsight_posteriors
from conformodal.localizer.observations import MotionPrior, choose_places, find_places
from conformodal.localizer.regions import EvidenceType, PoseRegions
from conformodal.tracking.tracker import FrontEnd, MotionFrontEnd, affine_flow

from .config import Method, OdometryError
from .estimates import Estimate, OdometryRun
from .model import HINDSIGHT, METHODS, ONLINE, RELIABLE, ExpectedInput, Localization, PoseModel, colours_of
from .store import load_model
from .stream import StreamRunner, as_trajectory

_FIRST = 10  # frames of a stream whose times and colours are looked at
_ROUNDING = 1e-9  # of p-values, relative


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
        with StreamRunner(odometry_of(self.model), keep_regions=True) as runner, closing(prefetch(stream)) as coming:
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


class VisualOdometry(Odometry):
    """Poses of one camera, frame by frame (:meth:`step`) or for a whole recording (:meth:`process`).

    ``examples/stream.py`` answers a camera or a video frame by frame, ``examples/images.py`` a whole data set.
    :attr:`Estimate.revised` goes back ten frames of a stream; :meth:`process` uses all.
    """

    answer = METHODS[0]
    whole_paths = True

    def __init__(self, model: PoseModel) -> None:
        if model.method is Method.PAPER:
            raise OdometryError("the model was trained with the paper's method; PaperOdometry runs it")
        self.model = model
        self._filter = PoseFilter(model.prior)
        self.reset()

    @classmethod
    def load(cls, folder: Path | str) -> Self:
        """Load a saved model; a ModelFileError says if it is missing, damaged or altered."""
        return cls(load_model(folder))

    def reset(self) -> None:
        """Forget the stream so far."""
        self._front_end = MotionFrontEnd(self.model.camera)
        self._watch = InputWatch(self.model.expected_input)
        self._filter.reset()
        model = self.model
        follows, quality = model.follows_streams, model.quality
        self._stream = FrameStream(model.localizer, model.camera, model.detector, follows=follows, quality=quality)
        self._last_s = self._usable_s = None

    def _answer(self, image: UInt8Array, timestamp_s: float) -> Estimate:
        grey = grey_image(image)  # once for tracker and local features
        motion = self._front_end.measure(grey)
        evidence = FrameEvidence(partial(self.model.backbone.features_of, image))
        carried = False
        if self.model.looks_at_local_features:
            look = self._look(grey, timestamp_s, motion)
            evidence = replace(evidence, local_features=[look.features], estimates=[look.estimates], busy=look.busy)
            carried = look.carried
        localization = self.model.localize(evidence)
        self._stream.observe(localization.beliefs.estimates[0])
        return replace(self._estimate(localization, motion, timestamp_s), carried=carried)

    def _look(self, grey: UInt8Array, timestamp_s: float, motion: RelativeMotion | None) -> FrameLook:
        """The local features of the next frame."""
        model, flow = self.model, NO_FLOW
        if self._usable_s is not None:
            flow = affine_flow(self._front_end.tracker.step, timestamp_s - self._usable_s, model.camera)

        def detect(turn_rad: float) -> LocalFeatures:
            return extract_local_features(grey, model.camera, model.detector, turn_rad)._replace(flow=flow)

        return self._stream.look(StreamFrame(grey, timestamp_s, motion, flow), detect)

    def _estimate(self, localization: Localization, motion: RelativeMotion | None, timestamp_s: float) -> Estimate:
        """The estimate of the next frame, from the posterior up to it."""
        candidates, shows_known = localization.candidates[0], bool(localization.known[0])
        posterior = self._filter.push(candidates, motion, timestamp_s, known=shows_known)
        places = find_places(posterior, self.model.prior)
        best = places[0]
        evidence, known_p = EvidenceType(int(localization.kinds[0])), float(localization.known_p[0])
        problems = [] if motion is None or motion.reliable else [str(motion.status)]
        if evidence is EvidenceType.UNKNOWN:
            problems.append(f"like no place that is known (p = {known_p:.2g})")
        elif known_p <= self._least_p:
            problems.append(f"recognised more weakly than every frame that calibrates (p = {known_p:.2g})")
        if best.probability < RELIABLE:
            problems.append(f"the most probable place has p = {best.probability:.2g}")
        pose = Trajectory(np.array([timestamp_s]), best.position_xyz[None], best.orientation_quat_wxyz[None])
        path_region = self.model.path_regions(localization, [posterior], ONLINE)
        problems += self._doubts(localization.regions if path_region is None else path_region, pose)
        if path_region is not None and not self._holds(localization.regions, pose):  # a path may be sure and wrong
            problems.append("the pose lies outside of the image's region")
        return Estimate(
            timestamp_s=timestamp_s,
            pose=pose,
            region=localization.regions,
            path_region=path_region,
            candidates=candidates,
            relative_motion=motion,
            reliable=not problems,
            problem="; ".join(problems),
            localization=localization,
            estimates=list(localization.beliefs.estimates[0]),
            known_p=None if np.isnan(known_p) else known_p,
            evidence=evidence,
            position_spread_m=float(np.linalg.norm(best.position_spreads)),
            orientation_spread_rad=best.orientation_spread_rad,
            posterior=posterior,
            places=places,
            tracks=self._front_end.tracks,
            corners=self._front_end.corners,
            revise=partial(_revised, self._filter.window(), self.model.prior),
        )

    @property
    def _least_p(self) -> float:
        """The p-value of an image that is recognised more weakly than every frame that calibrates."""
        novelty = self.model.novelty
        least = 0.0 if novelty is None else (novelty.matched or novelty.test).least_p
        return min(self.model.rules.level, (1 + _ROUNDING) * least)

    def _doubts(self, region: PoseRegions, pose: Trajectory) -> list[str]:
        """Why a calibrated region does not vouch for a pose."""
        if region.unbounded.any():
            return ["the region is unbounded"]
        if region.n_places[0] > 1:
            return [f"the region names {region.n_places[0]} places"]
        return [] if self._holds(region, pose) else ["the pose lies outside of its region"]

    def _holds(self, region: PoseRegions, pose: Trajectory) -> bool:
        """Whether a region contains a pose."""
        return bool(region.contains(pose_targets(pose, self.model.sign_reference), joint=True)[0])


def _revised(window: Window, prior: MotionPrior) -> Trajectory:
    """The poses of the last frames of a stream, in hindsight."""
    posteriors = hindsight_posteriors(window.seen, prior, window.forward)
    return as_trajectory(choose_places(posteriors, window.seen.timestamps_s, prior))


def odometry_of(model: PoseModel) -> Odometry:
    """The system that runs a model, by the model's method."""
    from .paper import PaperOdometry  # noqa: PLC0415 - not wanted by most

    return PaperOdometry(model) if model.method is Method.PAPER else VisualOdometry(model)


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
