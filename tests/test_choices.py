"""Arguments that stand for a member of an enumeration: text is read as the member, anything else is refused."""

import numpy as np
import pytest

from conformodal.conformal import ConformodalError
from conformodal.geometry import Trajectory, align
from conformodal.io import Split, make_split, read_recording
from conformodal.io.streams import open_stream
from conformodal.pipeline.config import ModelConfig

ROWS = np.arange(4)
STILL = Trajectory([0.0, 1.0, 2.0], np.zeros((3, 3)), np.tile([1.0, 0, 0, 0], (3, 1)))
PARTS = {"seed": 0, "train": ROWS, "calibration": ROWS, "test": ROWS}

# how a value gets there, and what the message calls it
ENTRIES = [
    (lambda v: read_recording("nowhere", v), "format"),
    (lambda v: open_stream("nowhere", v), "format"),
    (lambda v: Split(v, **PARTS), "split"),
    (lambda v: make_split(ROWS, v), "split"),
    (lambda v: align(STILL, STILL, v), "alignment"),
    (lambda v: ModelConfig(method=v), "method"),
    (lambda v: ModelConfig(split=v), "split"),
    (lambda v: ModelConfig(calibrate_on=v), "calibrate_on"),
]


@pytest.mark.parametrize("wrong", ["rubbish", 17, None, ["frame"]], ids=str)
@pytest.mark.parametrize(("enter", "argument"), ENTRIES)
def test_a_value_that_is_not_a_member_is_refused_where_it_enters(enter, argument, wrong):
    with pytest.raises(ConformodalError) as refused:
        enter(wrong)
    message = str(refused.value)
    assert argument in message
    assert repr(wrong) in message
    assert "\n" not in message
