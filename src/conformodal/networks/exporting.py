"""From torch to ONNX: a network that runs without torch."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import torch

from conformodal.core import needing
from conformodal.vision import Backbone, FeatureCache, OnnxBackbone, VisionError
from conformodal.vision.keeping import keep_arrays, kept_arrays
from conformodal.vision.onnx_backbone import INPUT, OUTPUT

from .torch_backbone import TorchBackbone

OPSET = 18
_TOLERANCE = 1e-3  # of the largest feature: rounding through some sixty layers; a wrong operator errs by far more


def exported(backbone: TorchBackbone, cache: FeatureCache) -> OnnxBackbone:
    """The same network in ONNX, from the cache where it is there; preprocessing is inside, the batch is dynamic.

    Raises
    ------
    VisionError
        If torch cannot export the network, or the exported one answers otherwise.
    MissingPackageError
        If a package for the export is not installed.
    """

    def make() -> bytes:
        content = _export(backbone)
        _check_same(backbone, OnnxBackbone(backbone.config, content))
        return content

    return kept_network(backbone, backbone.fingerprint, cache, make)


def kept_network(backbone: Backbone, key: str, cache: FeatureCache, make: Callable[[], bytes]) -> OnnxBackbone:
    """A backbone in the ONNX file that the cache holds under a key; it is made where the cache does not hold it."""
    path = None if cache.folder is None else cache.folder.parent / "networks" / f"{key}.safetensors"
    found = None if path is None else kept_arrays(path, key)
    content = make() if found is None else found["onnx"].tobytes()
    if path is not None and found is None:
        keep_arrays(path, key, {"onnx": np.frombuffer(content, dtype=np.uint8)})
    return OnnxBackbone(backbone.config, content)


def _export(backbone: TorchBackbone) -> bytes:
    with needing("train", "the export of a network"):
        import onnxscript  # noqa: F401, PLC0415 - torch asks for it
    two = torch.zeros((2, backbone.config.height, backbone.config.width, 3), dtype=torch.uint8, device=backbone.device)
    try:
        with _quiet():
            program = torch.onnx.export(
                backbone,
                (two,),
                dynamo=True,
                opset_version=OPSET,
                input_names=[INPUT],
                output_names=[OUTPUT],
                dynamic_shapes={"images": {0: torch.export.Dim("n")}},
                verbose=False,
            )
    except Exception as exc:  # whatever torch and onnxscript raise
        raise VisionError(f"{backbone.config.name} cannot be exported to ONNX: {exc}") from exc
    assert program is not None
    model = program.model_proto
    for part in (model, model.graph, *model.graph.node, *model.graph.value_info):
        del part.metadata_props[:]  # among them lines of source files of the machine that exports
    return bytes(model.SerializeToString())


def _check_same(backbone: TorchBackbone, made: OnnxBackbone) -> None:
    shape = (2, backbone.config.height, backbone.config.width, 3)
    images = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    expected, found = backbone.maps(images), made.maps(images)
    if expected.shape != found.shape or np.abs(found - expected).max() > _TOLERANCE * np.abs(expected).max():
        raise VisionError(f"{backbone.config.name} answers otherwise when exported to ONNX")


@contextmanager
def _quiet() -> Iterator[None]:
    """Without the exporter's remarks on packages that are not needed."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)
