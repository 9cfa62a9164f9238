"""What a stream may bring: images of other kinds, times that are none, blank frames."""

import re

import numpy as np
import pytest
from PIL import Image

from conformodal.io import read_recording
from conformodal.io.streams.frames import Frame
from conformodal.localizer.regions import EvidenceType
from conformodal.pipeline.config import OdometryError
from conformodal.pipeline.estimator import VisualOdometry
from conformodal.pipeline.results import ResultsWriter
from conformodal.pipeline.store import load_model
from conformodal.pipeline.stream import StreamRunner

H, W = 120, 160


@pytest.fixture(scope="module")
def model(small_world):
    return load_model(small_world.model)


@pytest.fixture(scope="module")
def images(small_world):
    sequence = read_recording(small_world.folder)
    return [sequence.image(i) for i in range(50, 54)]


@pytest.fixture(scope="module")
def plain(model, images):
    odometry = VisualOdometry(model)
    return [odometry.step(image, 0.1 * k) for k, image in enumerate(images)]


def same(one, other):
    """Answers are the same to the last bit."""
    for ours, theirs in zip(one.localization.beliefs.proba, other.localization.beliefs.proba, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    np.testing.assert_array_equal(one.pose.position_xyz, other.pose.position_xyz)
    np.testing.assert_array_equal(one.pose.orientation_quat_wxyz, other.pose.orientation_quat_wxyz)
    assert one.region.intervals(0)[0].tolist() == other.region.intervals(0)[0].tolist()
    assert (one.reliable, one.problem) == (other.reliable, other.problem)


def read_only(image):
    found = image.copy()
    found.flags.writeable = False
    return found


SAME_IMAGE = {
    "BGR turned to RGB by a view": lambda image: np.ascontiguousarray(image[:, :, ::-1])[:, :, ::-1],
    "read-only": read_only,
    "a Pillow image": Image.fromarray,
    "a masked array without a mask": np.ma.asarray,
}


@pytest.mark.parametrize("how", SAME_IMAGE)
def test_the_same_pixels_have_the_same_answer(model, images, plain, how):
    odometry = VisualOdometry(model)
    for k, image in enumerate(images):
        same(odometry.step(SAME_IMAGE[how](image), 0.1 * k), plain[k])


class Broken:
    def __array__(self, *_args, **_how):
        raise RuntimeError("the camera is gone")


NO_IMAGE = {
    "none": (None, "no image"),
    "grey": (np.zeros((H, W), np.uint8), r"uint8 .120, 160."),
    "floats": (np.zeros((H, W, 3)), "float64"),
    "masked": (np.ma.masked_equal(np.zeros((H, W, 3), np.uint8), 0), "masked"),
    "what raises": (Broken(), "the camera is gone"),
}


@pytest.mark.parametrize("what", NO_IMAGE)
def test_what_is_no_image_costs_one_frame(model, images, plain, what):
    image, match = NO_IMAGE[what]
    odometry = VisualOdometry(model)
    same(odometry.step(images[0], 0.0), plain[0])
    lost = odometry.step(image, 0.05)
    assert not lost.reliable
    assert lost.region is None
    assert lost.pose is None
    assert re.search(match, lost.problem), lost.problem
    odometry.track_only(image, 0.07)
    same(odometry.step(images[1], 0.1), plain[1])


TIMES = [np.nan, -np.inf, None, "soon", 1j, np.array([1.0, 2.0]), 10**400, np.datetime64("NaT")]


def test_a_time_that_is_not_one_is_an_error_and_changes_nothing(model, images, plain):
    odometry = VisualOdometry(model)
    for k in (0, 1):
        for time in TIMES:
            with pytest.raises(OdometryError, match="timestamp"):
                odometry.step(images[k], time)
        same(odometry.step(images[k], 0.1 * k), plain[k])


@pytest.mark.parametrize("time", [0.1, -1.0])
def test_time_does_not_go_back(model, images, plain, time):
    odometry = VisualOdometry(model)
    for k in (0, 1):
        same(odometry.step(images[k], 0.1 * k), plain[k])
    with pytest.raises(OdometryError, match=r"increase: .* s follows 0\.1 s"):
        odometry.step(images[2], time)
    same(odometry.step(images[2], 0.2), plain[2])
    assert odometry.step(None, 0.3).pose is None  # a frame that could not be used has a time too
    with pytest.raises(OdometryError, match=r"increase: .* s follows 0\.3 s"):
        odometry.step(images[3], 0.2 + time / 2)
    assert odometry.step(images[3], 0.35).pose is not None
    odometry.reset()
    same(odometry.step(images[0], 0.0), plain[0])


BLANK = {
    "black": np.zeros((H, W, 3), np.uint8),
    "covered": np.random.default_rng(0).integers(0, 4, (H, W, 3), dtype=np.uint8),
}


@pytest.mark.parametrize("what", BLANK)
def test_a_blank_first_frame_is_like_no_known_place(model, images, what):
    odometry = VisualOdometry(model)
    first = odometry.step(BLANK[what], 0.0)
    assert not first.reliable
    assert first.evidence is EvidenceType.UNKNOWN
    assert "no place that is known" in first.problem
    assert odometry.step(images[0], 0.1).pose is not None


@pytest.mark.parametrize(("time", "at"), [(np.nan, 0), (np.inf, 2)])
def test_a_frame_without_a_time_is_left_out_of_the_results(model, images, tmp_path, time, at):
    runner = StreamRunner(VisualOdometry(model), ResultsWriter(tmp_path))
    frames = [Frame(f"frame{k}", 0.1 * k, image) for k, image in enumerate(images)]
    frames.insert(at, Frame("bad", time, images[0]))
    answers = [runner.push(frame) for frame in frames]
    runner.finish()
    assert answers.pop(at) is None
    assert all(answer.pose is not None for answer in answers)
    assert list(runner.problems) == ["bad"]
    assert "finite" in runner.problems["bad"]
    assert (runner.n_answered, runner.n_problems) == (4, 1)
