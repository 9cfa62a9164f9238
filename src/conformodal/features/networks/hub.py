"""Vision models of Hugging Face's transformers, by name or folder: ``hf:google/efficientnet-b0``, ``hf:./my-model``.

Nothing is downloaded here: a model must be on this machine already (``hf download NAME`` fetches one). Weights are
safetensors, and no code of a model is run.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch
from torch import nn

from conformodal.core.extras import require_extra
from conformodal.features.settings import HUB_PREFIX, VisionError

from .lite import LoadedLayers

_STRIDE = 16


@dataclass(frozen=True)
class HubNetwork:
    """A model of transformers that gives maps; `model` is its name on the hub, or a folder."""

    model: str

    @property
    def block(self) -> int:
        """Hidden state to take: the last with as many channels as the first at a sixteenth of the resolution."""
        return _default_block(self.model)

    def load(self, block: int | None) -> LoadedLayers:
        """Layers up to a hidden state; None for all."""
        loaded, mean, scale = _load(self.model)
        digest = hashlib.sha256()
        for name, tensor in sorted(loaded.state_dict().items()):
            digest.update(name.encode())
            digest.update(tensor.contiguous().numpy().tobytes())
        return LoadedLayers([_HiddenState(loaded, block)], mean, scale, digest.digest())


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
        states = self.model(pixel_values=x, output_hidden_states=True).hidden_states
        if not 0 <= self.block < len(states):
            raise VisionError(f"block must be 0 to {len(states) - 1}, got {self.block}")
        state: torch.Tensor = states[self.block]
        return state


def _load(name: str) -> tuple[Any, tuple[float, ...], tuple[float, ...]]:
    with require_extra("hub", f"{HUB_PREFIX}{name}"):
        from transformers import AutoImageProcessor, AutoModel  # noqa: PLC0415 - heavy, and an extra
        from transformers.utils.logging import disable_progress_bar  # noqa: PLC0415
    disable_progress_bar()
    try:
        safe = {"local_files_only": True, "trust_remote_code": False}
        processor = AutoImageProcessor.from_pretrained(name, **safe)
        model = AutoModel.from_pretrained(name, use_safetensors=True, **safe)
    except (OSError, ValueError, KeyError, ImportError) as exc:
        raise VisionError(
            f"{HUB_PREFIX}{name}: no such model on this machine (fetch it with: hf download {name}): "
            f"{type(exc).__name__}: {str(exc).splitlines()[0]}"
        ) from exc
    mean, std = processor.image_mean, processor.image_std
    return model.eval(), tuple(255 * v for v in mean), tuple(255 * v for v in std)


@lru_cache(maxsize=8)
def _default_block(name: str) -> int:
    model, _, _ = _load(name)
    side = 8 * _STRIDE
    with torch.inference_mode():
        states = model(pixel_values=torch.zeros(1, 3, side, side), output_hidden_states=True).hidden_states
    if states is None or states[-1].ndim != 4:
        raise VisionError(f"{HUB_PREFIX}{name}: gives no maps (n, channels, h, w)")
    at = [k for k, state in enumerate(states) if state.shape[-1] == side // _STRIDE]
    if not at:
        return len(states) - 1
    return max(k for k in at if states[k].shape[1] == states[at[0]].shape[1])
