"""Arguments that stand for a member of an enumeration: text is read as the member, anything else is refused."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from conformodal.conformal import ConformodalError
from conformodal.geometry import RelativeMotion, Trajectory, align
from conformodal.geometry.relative import MotionStatus
from conformodal.io import Split, SplitKind, make_split, read_recording
from conformodal.io.convert import write_layout
from conformodal.io.splits import held_out_together
from conformodal.io.streams.opening import open_stream
from conformodal.io.streams.prefetch import prefetch
from conformodal.localizer.radius import Guarantee, PoseRadius, fit_pose_radius
from conformodal.localizer.region_rules import EvidenceType
from conformodal.localizer.sources.source_data import SourceData
from conformodal.pipeline.config import Calibration, Method, ModelConfig, Runtime
from conformodal.pipeline.estimates import Estimate
from conformodal.pipeline.folds import make_folds
from conformodal.pipeline.model import PoseModel
from conformodal.pipeline.results.records import region_record
from conformodal.pipeline.selection import calibrate_selection
from conformodal.ros.conventions import Conventions, Covariance
from conformodal.ros.conversion import pose_covariance
from experiments.conditions import TrainingTask

ROWS = np.arange(4)
STILL = Trajectory([0.0, 1.0, 2.0], np.zeros((3, 3)), np.tile([1.0, 0, 0, 0], (3, 1)))
PARTS = {"seed": 0, "train": ROWS, "calibration": ROWS, "test": ROWS}
LOST = (None,) * 4
BARE = (*(None,) * 3, SimpleNamespace(recognised=None), *(None,) * 4)
TASK = {"seed": 0, "used": 0.8, "network": "efficientnet_lite0", "sigmas": (0.0,), "epochs": 1, "data": ""}

# name: how a value gets there, and what the message calls it
ENTRIES = {
    "Conventions.covariance": (lambda v: Conventions(covariance=v), "covariance"),
    "pose_covariance": (lambda v: pose_covariance(Estimate(0.0, *LOST, False), v), "covariance"),
    "read_recording": (lambda v: read_recording("nowhere", v), "layout"),
    "open_stream": (lambda v: open_stream("nowhere", v), "layout"),
    "write_layout": (lambda v: write_layout(None, v, None, None, None), "layout"),
    "prefetch": (lambda v: next(prefetch(None, pace=v)), "pace"),
    "Split.kind": (lambda v: Split(v, **PARTS), "split"),
    "make_split": (lambda v: make_split(ROWS, v), "split"),
    "held_out_together": (lambda v: held_out_together(ROWS, v), "split"),
    "SourceData.split": (lambda v: SourceData(None, None, None, None, v), "split"),
    "align": (lambda v: align(STILL, STILL, v), "alignment"),
    "RelativeMotion.status": (RelativeMotion, "status"),
    "ModelConfig.method": (lambda v: ModelConfig(method=v), "method"),
    "ModelConfig.split": (lambda v: ModelConfig(split=v), "split"),
    "ModelConfig.calibrate_on": (lambda v: ModelConfig(calibrate_on=v), "calibrate_on"),
    "ModelConfig.runtime": (lambda v: ModelConfig(runtime=v), "runtime"),
    "PoseModel.method": (
        lambda v: PoseModel(*BARE, configuration={"method": v}).method,
        "method",
    ),
    "PoseRadius.guarantee": (lambda v: PoseRadius(1.0, 0.1, v, "online", 9), "guarantee"),
    "fit_pose_radius": (lambda v: fit_pose_radius([([1.0], [1.0])], 0.1, v, "online"), "guarantee"),
    "calibrate_selection": (lambda v: calibrate_selection(None, None, guarantee=v), "guarantee"),
    "make_folds": (lambda v: make_folds(None, None, v), "calibration"),
    "Estimate.evidence": (lambda v: Estimate(0.0, *LOST, False, evidence=v), "evidence"),
    "region_record": (lambda v: region_record("a", 0.0, None, [], kind=v), "kind"),
    "TrainingTask.method": (lambda v: TrainingTask(method=v, split="blocks", **TASK), "method"),
    "TrainingTask.split": (lambda v: TrainingTask(method="paper", split=v, **TASK), "split"),
}


@pytest.mark.parametrize("wrong", ["rubbish", 17, None, ["frame"]], ids=str)
@pytest.mark.parametrize("entry", ENTRIES)
def test_a_value_that_is_no_member_is_refused_where_it_enters(entry, wrong):
    if wrong is None and entry == "Estimate.evidence":
        pytest.skip("None says that there is no image")
    enter, argument = ENTRIES[entry]
    with pytest.raises(ConformodalError) as found:
        enter(wrong)
    message = str(found.value)
    assert message.startswith(f"{argument} must be one of ")
    assert message.endswith(f"got {wrong!r}")
    assert "\n" not in message


FIELDS = [
    (Conventions(covariance="chosen"), "covariance", Covariance.CHOSEN),
    (Split("recordings", **PARTS), "kind", SplitKind.RECORDINGS),
    (SourceData(None, None, None, None, "blocks"), "split", SplitKind.BLOCKS),
    (RelativeMotion("ok"), "status", MotionStatus.OK),
    (ModelConfig(method="conformodal"), "method", Method.CONFORMODAL),
    (ModelConfig(split="recordings"), "split", SplitKind.RECORDINGS),
    (ModelConfig(calibrate_on="stretches"), "calibrate_on", Calibration.STRETCHES),
    (ModelConfig(runtime="int8"), "runtime", Runtime.INT8),
    (PoseRadius(1.0, 0.1, "recording", "online", 9), "guarantee", Guarantee.RECORDING),
    (Estimate(0.0, *LOST, False, evidence=np.int64(3)), "evidence", EvidenceType.UNKNOWN),
    (TrainingTask(method="paper", split="blocks", **TASK), "method", Method.PAPER),
]


@pytest.mark.parametrize(("thing", "name", "member"), FIELDS, ids=lambda v: v if isinstance(v, str) else "")
def test_text_becomes_the_member_that_code_compares_with(thing, name, member):
    assert getattr(thing, name) is member
    assert getattr(dataclasses.replace(thing), name) is member
