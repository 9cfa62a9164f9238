"""What uncertainty and reasoning cost on top of a network, beside MC dropout and deep ensembles: time and memory.

python benchmarks/lightness.py [--frames 110] [--rounds 3]

Each way from pixels to an answer is a process of its own, kept to one core. Milliseconds are of the process's own
time on this core, so that other programs on the machine change them little.
"""

from __future__ import annotations

import argparse
import tempfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch
from common import REDKITCHEN, in_process, table_lines, train_briefly, write_page
from torch import nn

from conformodal.features.export import OPSET
from conformodal.features.networks.torch_backbone import TorchBackbone, backbone_config
from conformodal.io import read_sevenscenes

DROP_PATH = 0.2  # EfficientNet's own rate, of its last block
JOULES = Path("/sys/class/powercap")
WAYS = {
    "bare": "network with its head",
    "regions": "+ calibrated regions",
    "search": "+ calibrated regions, filter",
    "whole": "+ calibrated regions, filter, measured motion (a stream's whole answer, head alone)",
    "whole, three sources": "a stream's whole answer, three sources",
    "head dropout": "MC dropout x 30, head alone",
    "network dropout, shared": "MC dropout x 30, head and network, passes from the first dropout on",
    "network dropout": "MC dropout x 30, head and network, whole passes",
    "ensemble of heads": "deep ensemble, five heads on one network",
    "ensemble of networks": "deep ensemble, five networks with a head each",
}


class DropPath(nn.Module):
    """A block whose residual branch is left out at random, as in EfficientNet's own training."""

    def __init__(self, block: nn.Module, rate: float) -> None:
        super().__init__()
        self.block, self.rate = block, rate

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Of one image."""
        branch = self.block(x) - x
        mask = (torch.rand((1, 1, 1, 1)) >= self.rate).to(x.dtype)
        return x + branch * mask / (1 - self.rate)


class Front(nn.Module):
    """From pixels to where the first dropout is met."""

    def __init__(self, backbone: TorchBackbone, layers: list[nn.Module]) -> None:
        super().__init__()
        self.layers = nn.Sequential(*layers)
        self.mean, self.scale = backbone.pixel_mean, backbone.pixel_scale

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Of prepared images."""
        x = images.permute(0, 3, 1, 2).to(dtype=torch.float32)
        found: torch.Tensor = self.layers((x - self.mean) / self.scale)
        return found


def is_residual(layer: nn.Module) -> bool:
    """Whether a layer of EfficientNet is a block with a residual branch: those have dropout in training."""
    its: Any = getattr(layer, "_block_args", None)
    return its is not None and its.id_skip and its.stride in (1, [1]) and its.input_filters == its.output_filters


def export_dropout(folder: Path, width: int, height: int) -> int:
    """The network with its dropout in two ONNX files; returns how many blocks have it."""
    backbone = TorchBackbone(backbone_config(width, height))
    layers = list(backbone.layers)
    residual = [k for k, layer in enumerate(layers) if is_residual(layer)]
    first = residual[0]
    rest = [
        DropPath(layer, DROP_PATH * k / len(layers)) if k in residual else layer
        for k, layer in enumerate(layers[first:], first)
    ]
    front, rest_of = Front(backbone, layers[:first]), nn.Sequential(*rest, nn.Flatten(1))
    image = torch.zeros((1, backbone.config.height, backbone.config.width, 3), dtype=torch.uint8)
    for module, example, name, names in (
        (front, image, "front", ["images"]),
        (rest_of, front(image), "rest", ["start"]),
    ):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            program = torch.onnx.export(
                module.eval(), (example,), dynamo=True, opset_version=OPSET, input_names=names, verbose=False
            )
        assert program is not None
        (folder / f"{name}.onnx").write_bytes(program.model_proto.SerializeToString())
    return len(residual)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=110)
    parser.add_argument("--rounds", type=int, default=3)
    asked = parser.parse_args()
    sequence = read_sevenscenes(REDKITCHEN)
    images = sequence.image_paths[: asked.frames]
    spent: dict[str, list[float]] = {name: [] for name in WAYS}
    resident: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        train_briefly(sequence, folder / "head", "head")
        train_briefly(sequence, folder / "three")
        n_blocks = export_dropout(folder, sequence.camera.width, sequence.camera.height)
        for _ in range(asked.rounds):  # all ways in turn, so that what disturbs the machine disturbs all alike
            for name in WAYS:
                row = in_process("lightness_row.py", [name, str(folder), [str(path) for path in images]], 1)
                spent[name] += row["ms"]
                resident[name] = max(resident.get(name, 0.0), row["resident_mb"])
                print(name, float(np.median(row["ms"])), flush=True)
    median = {name: float(np.median(its)) for name, its in spent.items()}
    base = median["bare"]
    header = [
        "from pixels to an answer",
        "median, ms (10th to 90th percentile)",
        "of the bare network's",
        "resident, MB",
    ]
    rows = []
    for name, label in WAYS.items():
        low, high = np.percentile(spent[name], [10, 90])
        cell = f"{median[name]:.2f} ({low:.2f} to {high:.2f})"
        rows.append([label, cell, f"{median[name] / base:.2f}", f"{resident[name]:.0f}"])
    joules = (
        "Joules are not given: the machine has /sys/class/powercap, and this script does not read it."
        if JOULES.is_dir()
        else "Joules are not given: the machine does not tell them (no /sys/class/powercap)."
    )
    notes = [
        f"{asked.frames} consecutive frames of redkitchen, 640x480, reduced to 320x240 for the network in all rows, "
        f"10 of them to warm up, {asked.rounds} rounds over all rows; one thread of one core, that core's time. "
        "The head is the only source but in one row. The network is "
        "the features' part of EfficientNet-Lite0 in ONNX Runtime; heads are worked out with NumPy; the "
        "answer of a bare network is the mean of its softmaxes, that of MC dropout and ensembles mean and standard "
        "deviation of these means. Neither gives a region with guaranteed coverage, nor a path.",
        f"Uncertainty and reasoning together add {median['search'] / base - 1:.2f} times the bare network's time "
        f"({median['regions'] / base - 1:.2f} without the filter), and {median['whole'] / base - 1:.2f} times where "
        "the camera's motion is measured for the filter as well: corners and relative pose cost more than the network "
        "does. MC dropout depends on what has dropout. In the head alone, on a frozen network, thirty passes are one "
        f"matrix product, {median['head dropout'] / base:.2f} times the bare network. The network has dropout too, in "
        f"{n_blocks} blocks of these (residual branches that are left out at random, as EfficientNet is trained): "
        f"{median['network dropout, shared'] / base:.1f} times if passes start at the first of them, "
        f"{median['network dropout'] / base:.1f} times if they start at the pixels.",
        joules,
    ]
    title, command = "What uncertainty and reasoning cost", "python benchmarks/lightness.py"
    write_page("lightness", title, command, table_lines(header, rows), *notes)


if __name__ == "__main__":
    main()
