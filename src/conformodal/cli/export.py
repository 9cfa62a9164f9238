"""``conformodal export``: a model with its network in ONNX, for machines without torch."""

from __future__ import annotations

from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from conformodal.features.backbone import OnnxBackbone
from conformodal.features.extract import FeatureCache
from conformodal.io import Layout, Recording
from conformodal.pipeline.config import Runtime, config_of
from conformodal.pipeline.errors import OdometryError
from conformodal.pipeline.identity import identify, same_poses
from conformodal.pipeline.model import PoseModel
from conformodal.pipeline.results import lock_output
from conformodal.pipeline.store import load_model, save_model

from .console import print_where, progress_bars
from .failures import OptionError, report_errors
from .sources import Cache, DataLayout, FollowOutside, SavedModel, cache_folder, open_sequence
from .training import train_on


class Quantise(StrEnum):
    """Bits of an exported network."""

    NONE = "none"
    INT8 = "int8"


@report_errors()
def export(
    model: SavedModel,
    out: Annotated[Path, typer.Option(help="Folder for the exported model, which runs without torch.")],
    quantise: Annotated[
        Quantise, typer.Option(help="int8: quantise the network, then retrain and recalibrate the rest on --data.")
    ] = Quantise.NONE,
    data: Annotated[
        Path | None, typer.Option(help="The data set that the model was trained on, for --quantise.")
    ] = None,
    layout: DataLayout = Layout.AUTO,
    follow_outside: FollowOutside = False,
    cache: Cache = None,
) -> None:
    """Convert a model's network to ONNX, or quantise it to eight bits."""
    if (quantise is Quantise.INT8) != (data is not None):
        raise OptionError("--quantise int8 and --data go together: ranges and thresholds come from the training data")
    loaded, features = load_model(model), FeatureCache(cache_folder(cache))
    with lock_output(out, "train", apart=[model] if data is None else [model, data]):
        if data is None:
            save_model(_in_onnx(loaded, features), out)
        else:
            sequence = open_sequence(data, layout, require_poses=True, follow_outside=follow_outside)
            _check_same_data(loaded, sequence, model)
            config = replace(config_of(loaded.settings), runtime=Runtime.INT8)
            with progress_bars(out) as report:
                train_on(sequence, config, out, features=features, report=report)
    print_where(out)


def _in_onnx(model: PoseModel, features: FeatureCache) -> PoseModel:
    """A model with its network in ONNX, or in eight bits where it is already."""
    if isinstance(model.backbone, OnnxBackbone):
        return model
    # torch takes a second to import
    from conformodal.features.export import exported  # noqa: PLC0415
    from conformodal.features.networks.torch_backbone import TorchBackbone  # noqa: PLC0415

    assert isinstance(model.backbone, TorchBackbone)
    configuration = {**model.configuration, "runtime": str(Runtime.ONNX)}
    return replace(model, backbone=exported(model.backbone, features), configuration=configuration)


def _check_same_data(model: PoseModel, sequence: Recording, folder: Path) -> None:
    """Refuse other data than the model was trained on."""
    trained, here = model.known_frames, identify(sequence)
    whole = len(here) == len(trained) and bool((trained.files == here.files).all())
    if not (whole and same_poses(trained.poses, here.poses).all()):
        raise OdometryError(f"{sequence.name}: is not the data set that {folder} was trained on; give that one")
