"""Networks in eight bits: static quantisation by ONNX Runtime, on training images."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import numpy.typing as npt

from conformodal.core import Progress, needing
from conformodal.datasets import read_image
from conformodal.vision import FeatureCache, OnnxBackbone
from conformodal.vision.onnx_backbone import INPUT

from .exporting import kept_network

_N_IMAGES = 64  # ranges of activations hardly widen with more


def quantised(
    backbone: OnnxBackbone, image_files: Sequence[Path], cache: FeatureCache, progress: Progress | None = None
) -> OnnxBackbone:
    """The same network with weights and activations in eight bits.

    Weights have a scale a channel; ranges of activations are those of at most 64 of the images, spread evenly. The
    features are other ones: sources and thresholds have to be learnt from these.

    Parameters
    ----------
    backbone
        Stays as it is.
    image_files
        Of the training part.
    cache
        Keeps the network.
    progress
        Called with images done and images in all.

    Raises
    ------
    ImageError
        If an image cannot be read; names the file.
    MissingPackageError
        If a package for the quantisation is not installed.
    """
    chosen = [image_files[i] for i in np.unique(np.linspace(0, len(image_files) - 1, _N_IMAGES).round().astype(int))]
    key = hashlib.sha256("int8".join(cache.key(backbone, path) for path in chosen).encode()).hexdigest()

    def make() -> bytes:
        images = []
        for path in chosen:
            images.append(backbone.prepare(read_image(path)))
            if progress is not None:
                progress(len(images), len(chosen))
        return _quantise(backbone.content, images)

    return kept_network(backbone, key, cache, make)


def _quantise(content: bytes, images: Sequence[npt.NDArray[np.uint8]]) -> bytes:
    with needing("train", "quantisation"):
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
    """Without the advice to optimise the network first: the exporter has done so."""
    previous = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(previous)
