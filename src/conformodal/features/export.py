"""Networks in ONNX, which run without torch: exported, and quantised to eight bits."""

from __future__ import annotations

import hashlib
import logging
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from conformodal.core.arrays import UInt8Array, evenly_spread
from conformodal.core.extras import require_extra
from conformodal.core.progress import Progress
from conformodal.features.networks.torch_backbone import TorchBackbone
from conformodal.io import read_image

from .backbone import INPUT, OUTPUT, Backbone, OnnxBackbone
from .extract import FeatureCache
from .settings import VisionError

# What the oldest ONNX Runtime that is supported, 1.20, reads: IR 10 and opset 21. The exporter would write the newest.
OPSET, IR_VERSION = 18, 10
_N_IMAGES = 64  # of quantisation; ranges of activations hardly widen with more
_TOLERANCE = 1e-3  # of the largest feature: rounding through some sixty layers; a wrong operator errs by far more


def exported(backbone: TorchBackbone, cache: FeatureCache) -> OnnxBackbone:
    """The same network in ONNX, cached; preprocessing is included and the batch size dynamic."""

    def make() -> bytes:
        content = _export(backbone)
        _check_same(backbone, OnnxBackbone(backbone.config, content))
        return content

    return _cached_network(backbone, backbone.fingerprint, cache, make)


def quantised(
    backbone: OnnxBackbone, image_files: Sequence[Path], cache: FeatureCache, progress: Progress | None = None
) -> OnnxBackbone:
    """The same network with weights and activations in eight bits.

    Weights have one scale per channel; activation ranges are those of at most 64 of the images of the training part,
    spread evenly. The features change, so pose sources and thresholds must be learnt again.
    """
    chosen = [image_files[i] for i in evenly_spread(len(image_files), _N_IMAGES)]
    key = hashlib.sha256("int8".join(cache.key(backbone, path) for path in chosen).encode()).hexdigest()

    def make() -> bytes:
        images = []
        for path in chosen:
            images.append(backbone.prepare(read_image(path)))
            if progress is not None:
                progress(len(images), len(chosen))
        return _quantise(backbone.content, images)

    return _cached_network(backbone, key, cache, make)


def _cached_network(backbone: Backbone, key: str, cache: FeatureCache, make: Callable[[], bytes]) -> OnnxBackbone:
    """A backbone in the ONNX file that the cache holds under a key; it is made where the cache does not hold it."""
    cached = cache.load(key, "networks")
    content = make() if cached is None else cached.tobytes()
    if cached is None:
        cache.store(key, np.frombuffer(content, dtype=np.uint8), "networks")
    return OnnxBackbone(backbone.config, content)


def _export(backbone: TorchBackbone) -> bytes:
    with require_extra("train", "the export of a network"):
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
    model.ir_version = IR_VERSION
    for part in (model, model.graph, *model.graph.node, *model.graph.value_info):
        del part.metadata_props[:]  # among them lines of source files of the machine that exports
    return bytes(model.SerializeToString())


def _check_same(backbone: TorchBackbone, made: OnnxBackbone) -> None:
    shape = (2, backbone.config.height, backbone.config.width, 3)
    images = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    expected, maps = backbone.maps(images), made.maps(images)
    if expected.shape != maps.shape or np.abs(maps - expected).max() > _TOLERANCE * np.abs(expected).max():
        raise VisionError(f"{backbone.config.name} answers otherwise when exported to ONNX")


def _quantise(content: bytes, images: Sequence[UInt8Array]) -> bytes:
    with require_extra("train", "quantisation"):
        from onnxruntime.quantization import (  # noqa: PLC0415 - only here
            CalibrationDataReader,
            QuantFormat,
            QuantType,
            quantize_static,
        )

    class Images(CalibrationDataReader):  # type: ignore[misc]
        def __init__(self) -> None:
            self.left = iter(images)

        def get_next(self) -> dict[str, Any] | None:
            image = next(self.left, None)
            return None if image is None else {INPUT: image[None]}

    with TemporaryDirectory() as folder, _quiet():
        whole, small = Path(folder) / "network.onnx", Path(folder) / "int8.onnx"
        whole.write_bytes(content)
        quantize_static(
            whole,
            small,
            Images(),
            quant_format=QuantFormat.QDQ,
            per_channel=True,
            activation_type=QuantType.QUInt8,  # with signed activations, kernels for convolutions are slower
            weight_type=QuantType.QInt8,
        )
        return small.read_bytes()


@contextmanager
def _quiet() -> Iterator[None]:
    """Hide advice of exporter and quantiser: on packages that are not needed, and to optimise the network first."""
    previous = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(previous)
