import json
import shutil

import numpy as np
import pytest

from conformodal.features.backbone import OnnxBackbone
from conformodal.features.networks.torch_backbone import TorchBackbone
from conformodal.pipeline.store import load_model, save_model
from tests.helpers import invoke, refusal, run_ok


def runtime_of(folder):
    return json.loads(invoke("info", folder, "--json").stdout)["runtime"]


@pytest.fixture
def in_torch(small_world, tmp_path):
    """The small model with its network in torch."""
    model = load_model(small_world.model)
    model.backbone = TorchBackbone(model.backbone.config)
    model.configuration = {**model.configuration, "runtime": "torch"}
    save_model(model, tmp_path / "torch")
    assert not list((tmp_path / "torch").glob("*.onnx"))
    return tmp_path / "torch"


def test_a_model_in_torch_is_exported(small_world, in_torch, tmp_path):
    run_ok("export", in_torch, "--out", tmp_path / "out", "--cache", tmp_path / "cache")
    made = load_model(tmp_path / "out")
    assert isinstance(made.backbone, OnnxBackbone)
    assert made.backbone.content == load_model(small_world.model).backbone.content
    np.testing.assert_array_equal(made.calibration.scores_, load_model(in_torch).calibration.scores_)
    assert [runtime_of(folder) for folder in (in_torch, tmp_path / "out")] == ["torch", "onnx"]
    assert made.configuration["runtime"] == "onnx"


@pytest.mark.slow
def test_eight_bits_are_learnt_and_calibrated_anew(small_world, tmp_path):
    out = tmp_path / "int8"
    arguments = ["--out", out, "--cache", small_world.cache, "--quantise", "int8", "--data", small_world.folder]
    run_ok("export", small_world.model, *arguments)
    whole, made = load_model(small_world.model), load_model(out)
    assert len(made.backbone.content) < len(whole.backbone.content)
    assert made.configuration == {**whole.configuration, "runtime": "int8"}
    np.testing.assert_array_equal(made.split.calibration, whole.split.calibration)
    assert made.calibration.scores_.shape == whole.calibration.scores_.shape
    assert (made.calibration.scores_ != whole.calibration.scores_).any()
    assert json.loads((out / "metrics.json").read_text())["configuration"]["runtime"] == "int8"
    np.testing.assert_array_equal(made.landmarks.frames, whole.landmarks.frames)
    assert runtime_of(out) == "int8"


def test_other_data_is_refused(small_world, tmp_path):
    data = shutil.copytree(small_world.folder, tmp_path / "data")
    (data / "seq-01" / "frame-000000.pose.txt").write_bytes((data / "seq-01" / "frame-000050.pose.txt").read_bytes())
    arguments = ["--out", tmp_path / "out", "--quantise", "int8", "--data", data]
    assert "is not the data set" in refusal("export", small_world.model, *arguments)
