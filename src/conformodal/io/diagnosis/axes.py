"""Axes of cameras, bodies and worlds: all 48, named by where x, y and z point as the camera sees.

OpenCV's camera is ``right-down-forward``, a body of ROS ``forward-left-up``, one in a north-east-down world
``forward-right-down``. Half of the 48 are left-handed: those of game engines, and those of mirrored images.
"""

from __future__ import annotations

import re
from itertools import permutations, product

import numpy as np

from conformodal.core.arrays import FloatArray
from conformodal.geometry import Trajectory
from conformodal.io.errors import DatasetError

OPENCV = "right-down-forward"
_DIRECTIONS = {
    "right": (1, 0, 0),
    "left": (-1, 0, 0),
    "down": (0, 1, 0),
    "up": (0, -1, 0),
    "forward": (0, 0, 1),
    "back": (0, 0, -1),
}
_USERS = {
    OPENCV: "OpenCV",
    "right-up-back": "OpenGL",
    "forward-left-up": "a body of ROS",
    "forward-right-down": "a body in a north-east-down world",
    "right-forward-up": "a body in an east-north-up world",
    "right-up-forward": "Unity, left-handed",
    "forward-right-up": "Unreal, left-handed",
}
# what else than axes it is where only the image plane is turned or mirrored
_OF_IMAGES = {
    "down-left-forward": "images turned by 90 degrees clockwise",
    "left-up-forward": "images turned by 180 degrees",
    "up-right-forward": "images turned by 90 degrees counterclockwise",
    "left-down-forward": "images mirrored left to right",
    "right-up-forward": "images flipped top to bottom",
    "down-right-forward": "images turned by 90 degrees clockwise and then mirrored left to right",
    "up-left-forward": "images turned by 90 degrees counterclockwise and then mirrored left to right",
}
_OPPOSITE = "left-up-back"  # the same as OpenCV's axes but for the sign of all positions
_MIRROR = np.diag([-1.0, 1.0, 1.0])
_WORLD = re.compile(r"([+-]?)([xyz])")


def signed_permutations(*, proper: bool) -> list[FloatArray]:
    """The 24 turns (3, 3) of axes onto axes, or the 24 that also mirror; the identity first of the turns."""
    matrices = [
        np.eye(3)[list(order)] * np.array(signs)[:, None]
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
    ]
    return [matrix for matrix in matrices if (np.linalg.det(matrix) > 0) == proper]


def parse_axes(text: str) -> FloatArray:
    """Columns (3, 3): where x, y and z point in the camera's frame, from names or initials (``flu``)."""
    words = text.strip().lower().split("-") if "-" in text else list(text.strip().lower())
    names = [name for word in words for name in _DIRECTIONS if word in (name, name[0])]
    columns = np.array([_DIRECTIONS[name] for name in names], dtype=np.float64).reshape(-1, 3).T
    if len(words) != 3 or columns.shape != (3, 3) or abs(np.linalg.det(columns)) != 1:
        expected = "where x, y and z point as the camera sees, such as forward-left-up or flu"
        raise DatasetError(f"axes must say {expected}, got {text!r}")
    return columns


def parse_world_axes(text: str) -> FloatArray:
    """The turn (3, 3) of positions whose x, y and z are to be those named, such as ``y,x,-z``."""
    rows = [_WORLD.fullmatch(word.strip().lower()) for word in text.split(",")]
    turn = np.array([np.eye(3)["xyz".index(row[2])] * (-1 if row[1] == "-" else 1) for row in rows if row is not None])
    if len(rows) != 3 or turn.shape != (3, 3) or abs(np.linalg.det(turn)) != 1:
        raise DatasetError(f"world axes must be x, y and z in some order, such as y,x,-z, got {text!r}")
    return turn


def name_axes(columns: FloatArray) -> str:
    """The name of axes (3, 3), see :func:`parse_axes`."""
    names = {direction: name for name, direction in _DIRECTIONS.items()}
    return "-".join(names[tuple(np.round(column).astype(int).tolist())] for column in columns.T)


def name_world_axes(turn: FloatArray) -> str:
    """The name of a turn of positions, see :func:`parse_world_axes`."""
    at = np.abs(turn).argmax(axis=1)
    return ",".join(f"{'-' if turn[row, k] < 0 else ''}{'xyz'[k]}" for row, k in enumerate(at.tolist()))


def is_left_handed(columns: FloatArray) -> bool:
    """Whether axes (3, 3) are a mirror image of OpenCV's."""
    return bool(np.linalg.det(columns) < 0)


def is_usual(columns: FloatArray) -> bool:
    """Whether axes (3, 3) are those of a known system, or of turned or mirrored images."""
    return name_axes(columns) in {**_USERS, **_OF_IMAGES}


def describe_axes(columns: FloatArray) -> str:
    """What axes (3, 3) of poses are, for people; of left-handed ones, which images have the same geometry."""
    name = name_axes(columns)
    user = f" ({_USERS[name]})" if name in _USERS else ""
    axes = f"{'left-handed ' if is_left_handed(columns) and not user else ''}axes {name}{user}"
    if name in _OF_IMAGES:
        return f"{axes}, or {_OF_IMAGES[name]}" if user else _OF_IMAGES[name]
    if not is_left_handed(columns):
        return axes
    if name == _OPPOSITE:
        axes = f"positions of the other sign, or {axes}"
    behind = name_axes(_MIRROR @ columns)
    mirrored = f"images mirrored left to right, and axes {behind}" + (
        f" ({_USERS[behind]})" if behind in _USERS else ""
    )
    return f"{axes}, or {mirrored}" if user or behind not in _USERS else f"{mirrored}, or {axes}"


def advise_axes(columns: FloatArray) -> str:
    """How to convert poses of axes (3, 3), or what else to do."""
    name = name_axes(columns)
    convert = f"'conformodal data convert --axes {name}'"
    if not is_left_handed(columns):
        return f"{convert} turns the poses" + (", or turn the images back" if name in _OF_IMAGES else "")
    if name in _USERS:
        return f"{convert} if the poses are of such axes; mirrored images are to be mirrored back"
    behind = name_axes(_MIRROR @ columns)
    if name == _OPPOSITE:
        return (
            "'conformodal data convert --world-axes=-x,-y,-z' if positions have the other sign; else mirror the images"
        )
    then = "" if name in _OF_IMAGES else f", and convert the poses with --axes {behind}"
    return f"mirror the images back, since no turn of the poses can{then}"


def to_opencv(poses_se3: FloatArray, columns: FloatArray) -> FloatArray:
    """Poses (n, 4, 4) of bodies of other axes (3, 3) as those of OpenCV's camera.

    Left-handed poses become right-handed: their world is mirrored in the same way.
    """
    change = np.eye(4)
    change[:3, :3] = columns
    turned = poses_se3 @ change.T
    return np.asarray(change @ turned if is_left_handed(columns) else turned)


def convert_poses(
    poses: Trajectory, axes: str = OPENCV, world_axes: str = "x,y,z", *, world_to_camera: bool = False
) -> Trajectory:
    """Poses of other conventions as camera-to-world ones of OpenCV's axes.

    Parameters
    ----------
    poses
        As they were read.
    axes
        Where x, y and z of the bodies point as the camera sees, see :func:`parse_axes`.
    world_axes
        Which of the positions' axes are x, y and z of the orientations' world, see :func:`parse_world_axes`.
    world_to_camera
        Whether the poses are inverse.

    Raises
    ------
    DatasetError
        If names of axes are none.
    """
    columns, turn = parse_axes(axes), parse_world_axes(world_axes)
    matrices: FloatArray = np.array(poses.poses_se3)
    matrices = np.asarray(np.linalg.inv(matrices)) if world_to_camera else matrices
    matrices[:, :3, 3] = matrices[:, :3, 3] @ turn.T
    return Trajectory.from_poses_se3(poses.timestamps_s, to_opencv(matrices, columns))
