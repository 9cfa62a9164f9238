"""Focal lengths that --focal auto fits to poses and images, beside the true ones, on whole recordings and quarters.

python benchmarks/focal.py
"""

from __future__ import annotations

import re
import warnings
from dataclasses import replace

import numpy as np
from common import DATA, REDKITCHEN, write_table

from conformodal.geometry import PinholeCamera
from conformodal.io import DatasetError, DatasetWarning, Recording, read_recording
from conformodal.io.convention import FITTED, with_fitted_focal

# Pixels: redkitchen's by COLMAP (Brachmann et al. 2021), the others' by TUM, the mean of fx and fy of a camera with
# distortion.
RECORDINGS = {
    "fr1_desk": (DATA / "tum" / "fr1_desk", 516.9),
    "fr1_xyz": (DATA / "tum" / "fr1_xyz", 516.9),
    "redkitchen": (REDKITCHEN, 525.5),
}
QUARTERS = 4


def part_of(sequence: Recording, frames: np.ndarray) -> Recording:
    """Some frames, by a camera of which only the size is known."""
    width, height = sequence.camera.width, sequence.camera.height
    return replace(
        sequence,
        image_paths=tuple(sequence.image_paths[i] for i in frames),
        timestamps_s=sequence.timestamps_s[frames],
        recording=sequence.recording[frames],
        camera=PinholeCamera(width, width, width / 2, height / 2, width, height),
        truth=sequence.require_truth()[frames],
        given_test=None,
        notes=(),
    )


def row_of(name: str, sequence: Recording, true_px: float) -> list[str]:
    head = [name, str(len(sequence)), f"{true_px:g}"]
    try:
        fitted = with_fitted_focal(sequence)
    except DatasetError:
        return [*head, "refused", "", "", "", ""]
    found = re.search(r"between (\d+) and (\d+)", dict(fitted.notes)[FITTED])
    assert found is not None
    low, high = int(found[1]), int(found[2])
    px = fitted.camera.fx
    half = 100 * np.log(high / low) / 2
    error = 100 * (px / true_px - 1)
    inside = "yes" if low <= true_px <= high else "no"
    return [*head, f"{px:.0f}", f"{error:+.1f}", f"{low} to {high}", f"{half:.0f}", inside]


def main() -> None:
    warnings.simplefilter("ignore", DatasetWarning)
    rows = []
    for name, (folder, true_px) in RECORDINGS.items():
        sequence = read_recording(folder)
        every = np.arange(len(sequence))
        rows.append(row_of(name, part_of(sequence, every), true_px))
        quarters = np.array_split(every, QUARTERS)
        rows += [row_of(f"{name}, quarter {k}", part_of(sequence, its), true_px) for k, its in enumerate(quarters, 1)]
    write_table(
        "focal",
        "Focal lengths fitted to poses and images",
        "python benchmarks/focal.py",
        [
            "recording",
            "frames",
            "true, px",
            "fitted, px",
            "error, %",
            "95 % range, px",
            "half of it, %",
            "holds the truth",
        ],
        rows,
        "The principal point is taken as the middle and the lens as without distortion, and neither is. The true focal "
        "lengths are those of cameras with distortion (TUM) and of COLMAP (redkitchen).",
    )


if __name__ == "__main__":
    main()
