"""The radius around a pose in a recording left out, for systems that others published.

python benchmarks/radius.py
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from common import DATA, parser_of, table_lines, write_page
from scipy.spatial.transform import Rotation

from conformodal.core.arrays import FloatArray
from conformodal.geometry import Trajectory
from conformodal.localizer.radius import METRES_PER_RAD, Guarantee, fit_pose_radius, joint_error, pose_errors

Poses = dict[str, dict[int, FloatArray]]  # by recording and frame: quaternion and translation, world to camera

ALPHA = 0.1
FRAMES_PER_S = 30.0
SCENES = ("chess", "fire", "heads", "office", "pumpkin", "redkitchen", "stairs")
SYSTEMS = {"hloc": "hloc", "as": "Active Search", "dsac_rgb": "DSAC*", "r2d2_rgb": "R2D2"}
TRUTHS = ("dslam", "sfm")
DEPTHS_M = (1.0, 2.0, 4.0)


@dataclass(frozen=True, eq=False)
class Answers:
    """Errors (n,) of the answers to one recording, infinite without one; `depth_m` weighs as much as a radian."""

    scene: str
    metres: FloatArray
    radians: FloatArray
    depth_m: float = METRES_PER_RAD


def read_poses(path: str) -> Poses:
    """Rows ``seq-NN/frame-NNNNNN.color.png qw qx qy qz tx ty tz ...``."""
    poses: Poses = {}
    for row in (DATA / "recordings" / path).read_text(encoding="utf-8").splitlines():
        name, *numbers = row.split()
        recording, frame = name.split("/")
        poses.setdefault(recording, {})[int(frame.split("-")[1].split(".")[0])] = np.array(numbers[:7], dtype=float)
    return poses


def trajectory(frames: list[int], poses: dict[int, FloatArray]) -> Trajectory:
    """Camera-to-world poses of frames."""
    rows = np.array([poses[frame] for frame in frames])
    turns = Rotation.from_quat(rows[:, :4], scalar_first=True).inv()
    return Trajectory(np.array(frames) / FRAMES_PER_S, -turns.apply(rows[:, 4:]), turns.as_quat(scalar_first=True))


def read_recordings(truth: str, system: str) -> list[Answers]:
    """All recordings of all scenes."""
    every = []
    for scene in SCENES:
        true = read_poses(f"truth/{truth}/{scene}.txt")
        estimates = read_poses(f"estimates/{truth}/{scene}_{system}.txt")
        for name in sorted(true):
            frames = sorted(true[name])
            answered = np.array([frame in estimates.get(name, {}) for frame in frames])
            common = [frame for frame, has in zip(frames, answered, strict=True) if has]
            metres, radians = (np.full(len(frames), np.inf) for _ in range(2))
            poses = trajectory(common, estimates[name])
            metres[answered], radians[answered] = pose_errors(poses, trajectory(common, true[name]))
            every.append(Answers(scene, metres, radians))
    return every


def leave_out(recordings: list[Answers], *, scenes: bool = False) -> FloatArray:
    """Share inside and radius in radians (K, 2) of each recording, calibrated on all others, or all other scenes."""
    rows = []
    for i, left in enumerate(recordings):
        rest = [other for j, other in enumerate(recordings) if (other.scene != left.scene if scenes else j != i)]
        errors = [(other.metres, other.radians) for other in rest]
        radius = fit_pose_radius(errors, ALPHA, Guarantee.FRAME, "", metres_per_rad=left.depth_m)
        inside = joint_error(left.metres, left.radians, left.depth_m) <= radius.radius_rad
        rows.append((inside.mean(), radius.radius_rad))
    return np.array(rows)


def row(truth: str, system: str, outcome: FloatArray) -> list[str]:
    share, radius = outcome.T
    radii = [f"{METRES_PER_RAD * radius.mean():.4f}", f"{np.degrees(radius.mean()):.2f}"]
    return [truth, SYSTEMS[system], f"{share.mean():.3f}", f"{share.min():.2f}", *radii]


def main() -> None:
    parser_of(__doc__).parse_args()
    every = {(truth, system): read_recordings(truth, system) for truth in TRUTHS for system in SYSTEMS}
    left_out = [row(*key, leave_out(recordings)) for key, recordings in every.items()]
    scenes = [row(*key, leave_out(recordings, scenes=True)) for key, recordings in every.items()]
    depths = []
    for depth in DEPTHS_M:
        for truth in TRUTHS:
            share = [leave_out([replace(r, depth_m=depth) for r in every[truth, s]])[:, 0] for s in SYSTEMS]
            depths.append([f"{depth:g}", truth, f"{np.mean(share):.3f}", f"{np.min(share):.2f}"])
    header = ["truth", "system", "mean inside", "worst recording", "mean radius (m)", "mean radius (degrees)"]
    write_page(
        "radius",
        "The radius in recordings left out",
        "python benchmarks/radius.py",
        f"The 18 test recordings of 7-Scenes, each left out once while the 17 others calibrate; {1 - ALPHA:g} asked, a "
        "frame at random, recordings weighted equally. A frame without an answer is infinitely far off. Poses of four "
        "published systems, compared with the truth under which each was trained or mapped. One radian weighs as much "
        f"as {METRES_PER_RAD:g} m, everywhere. Radii: mean over recordings.",
        table_lines(header, left_out),
        "## How many metres weigh as much as one radian",
        "Looked at on both truths; a round depth of a room was chosen. All systems together.",
        table_lines(["metres", "truth", "mean inside", "worst recording"], depths),
        "## A scene left out",
        "Not covered by the guarantee: no recording of the same scene calibrates, so recordings are not exchangeable.",
        table_lines(header, scenes),
    )


if __name__ == "__main__":
    main()
