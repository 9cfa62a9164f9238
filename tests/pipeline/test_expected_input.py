"""Streams whose times are in another unit, or whose images have red and blue swapped."""

import warnings

import pytest

from conformodal.io import read_recording
from conformodal.pipeline.config import OdometryError
from conformodal.pipeline.model import ExpectedInput
from conformodal.pipeline.odometry import InputWatch

pytestmark = pytest.mark.filterwarnings("ignore::conformodal.io.DatasetWarning")
FR1_STEP_S = 1 / 15


@pytest.fixture(scope="module")
def recording(real_data):
    return read_recording(real_data("tum", "fr1_desk"))


@pytest.fixture
def watch(recording):
    return InputWatch(ExpectedInput.of(recording))


def test_the_usual_step_is_that_of_the_recording(recording):
    assert ExpectedInput.of(recording).step_s == pytest.approx(FR1_STEP_S, rel=0.2)


@pytest.mark.parametrize("unit", [1e3, 1e6, 1e9])
def test_times_in_another_unit_are_refused(watch, unit):
    for _ in range(9):
        watch.check_step(FR1_STEP_S * unit)
    for _ in range(2):  # as long as they come
        with pytest.raises(OdometryError, match="must be in seconds: the first 10 steps"):
            watch.check_step(FR1_STEP_S * unit)


@pytest.mark.parametrize("steps", [[1e6] + 19 * [0.1], 20 * [2.0], 20 * [1e-3], 15 * [0.1] + [1e9]])
def test_gaps_and_other_rates_are_sound(watch, steps):
    for step in steps:
        watch.check_step(step)


@pytest.mark.parametrize("of_another", [False, True])
def test_swapped_channels_warn_once(recording, watch, real_data, of_another):
    source = read_recording(real_data("tum", "fr1_xyz")) if of_another else recording
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        for i in range(0, 300, 10):
            watch.check_colours(source.image(i)[..., ::-1])
    assert ["seem to be BGR" in str(one.message) for one in told] == [True]


@pytest.mark.parametrize("changed", [lambda image: image, lambda image: image // 3, lambda image: image[..., [1] * 3]])
def test_correct_images_do_not_warn(recording, watch, changed):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for i in range(0, 300, 10):
            watch.check_colours(changed(recording.image(i)))
