"""Focal lengths that --focal auto fits to poses and images, beside the true ones, on whole recordings and quarters.

python benchmarks/focal.py
"""

from __future__ import annotations

import re
import warnings

import numpy as np
from common import DATA, REDKITCHEN, parser_of, part_of, write_table

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


def without_camera(sequence: Recording, frames: np.ndarray) -> Recording:
    """Some frames, by a camera of which only the size is known."""
    width, height = sequence.camera.width, sequence.camera.height
    camera = PinholeCamera(width, width, width / 2, height / 2, width, height)
    return part_of(sequence, frames, camera=camera, notes=())


def row_of(name: str, sequence: Recording, true_px: float) -> list[str]:
    head = [name, str(len(sequence)), f"{true_px:g}"]
    try:
        fitted = with_fitted_focal(sequence)
    except DatasetError:
        return [*head, "refused", "", "", "", ""]
    limits = re.search(r"between (\d+) and (\d+)", dict(fitted.notes)[FITTED])
    assert limits is not None
    low, high = int(limits[1]), int(limits[2])
    px = fitted.camera.fx
    half = 100 * np.log(high / low) / 2
    error = 100 * (px / true_px - 1)
    inside = "yes" if low <= true_px <= high else "no"
    return [*head, f"{px:.0f}", f"{error:+.1f}", f"{low} to {high}", f"{half:.0f}", inside]


def main() -> None:
    parser_of(__doc__).parse_args()
    warnings.simplefilter("ignore", DatasetWarning)
    rows = []
    for name, (folder, true_px) in RECORDINGS.items():
        sequence = read_recording(folder)
        every = np.arange(len(sequence))
        parts = {name: every}
        parts |= {f"{name}, quarter {k}": part for k, part in enumerate(np.array_split(every, QUARTERS), 1)}
        rows += [row_of(label, without_camera(sequence, part), true_px) for label, part in parts.items()]
    header = ["recording", "frames", "true, px", "fitted, px", "error, %", "95 % range, px", "half of it, %"]
    note = (
        "The principal point is taken as the middle and the lens as without distortion, and neither is. The true focal "
        "lengths are those of cameras with distortion (TUM) and of COLMAP (redkitchen)."
    )
    title, command = "Focal lengths fitted to poses and images", "python benchmarks/focal.py"
    write_table("focal", title, command, [*header, "holds the truth"], rows, note)


if __name__ == "__main__":
    main()
