"""Draws docs/images/frames.svg: the frames of a pose message, for docs/robots.md.

python docs/frames.py
"""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

PICTURE = Path(__file__).parent / "images" / "frames.svg"

COLOURS = ("#B5303B", "#1A7F37", "#0B5CAD")  # x, y, z, as ROS colours them
GREY, FILL = "#5A5A5A", "#D6E9F8"
# What the paper shows of x (towards the reader and left), y (right) and z (up) of the world.
PROJECTION = np.array([[-0.42, 1.0, 0.0], [-0.34, 0.0, 1.0]])
# Columns: a camera's right, down and forward in the world; the camera looks along the world's y, then is turned.
LOOKS_ALONG_Y = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
CAMERA = Rotation.from_euler("z", 62, degrees=True).as_matrix() @ LOOKS_ALONG_Y
AT = np.array([0.0, 3.2, 1.1])

FloatArray = npt.NDArray[np.float64]


def flat(points: npt.ArrayLike) -> FloatArray:
    """Places (..., 2) on the paper of points (..., 3) of the world."""
    return np.asarray(points, dtype=np.float64) @ PROJECTION.T


def draw() -> Figure:
    """World, camera and a robot's body, with the transform from one to the next."""
    figure = Figure(figsize=(10, 4.6))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(-1.6, 9.8), ylim=(-1.95, 3.3), aspect="equal")
    axes.set_axis_off()
    _draw_axes(axes, np.zeros(3), np.eye(3), ("x", "y", "z"), length=1.2)
    axes.text(*flat((0, 0, -0.8)), "map", ha="center", weight="bold", fontsize=12)
    axes.text(*flat((0, 0, -1.12)), "world of the training poses", ha="center", color=GREY, fontsize=10)
    _draw_camera(axes)
    _draw_transform(axes)
    _draw_body(axes, np.array([0.0, 7.0, 0.3]))
    return figure


def _draw_axes(axes: Axes, at: FloatArray, R_world_own: FloatArray, names: tuple[str, ...], length: float) -> None:
    start = flat(at)
    for column, name, colour in zip(R_world_own.T, names, COLOURS, strict=True):
        end = flat(at + length * column)
        style = {"arrowstyle": "-|>", "color": colour, "lw": 2.2, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 14}
        axes.annotate("", end, start, arrowprops=style, zorder=5)
        away = (end - start) / np.linalg.norm(end - start)
        side = "left" if away[0] > 0.4 else "right" if away[0] < -0.4 else "center"
        level = "bottom" if away[1] > 0.8 else "top" if away[1] < -0.8 else "center"
        axes.text(*(end + 0.08 * away), name, color=colour, fontsize=11, ha=side, va=level, weight="bold")


def _draw_camera(axes: Axes) -> None:
    """The image as it stands before the camera: columns run along x, rows along y."""
    corners = np.array([[-0.62, -0.46, 1.0], [0.62, -0.46, 1.0], [0.62, 0.46, 1.0], [-0.62, 0.46, 1.0]])
    image = flat(AT + corners @ CAMERA.T)
    axes.fill(*image.T, fc=FILL, ec=GREY, lw=1, zorder=1)
    for corner in image:
        axes.plot(*np.array([flat(AT), corner]).T, color=GREY, lw=0.8, zorder=1)
    _draw_axes(axes, AT, CAMERA, ("x right", "y down", "z forward"), length=1.7)
    middle = flat(AT)[0] + 0.7
    axes.text(middle, 2.95, "camera_optical_frame", ha="center", weight="bold", fontsize=12)
    axes.text(middle, 2.63, "the image stands before the camera", ha="center", color=GREY, fontsize=10)


def _draw_transform(axes: Axes) -> None:
    start, end = flat((0, 0.15, 0.1)), flat(AT - np.array([0, 0.12, 0.02]))
    style = {"arrowstyle": "-|>", "connectionstyle": "arc3,rad=-0.22", "lw": 1.3, "ls": "--", "mutation_scale": 12}
    axes.annotate("", end, start, arrowprops=style)
    axes.text(1.55, 1.28, "T_world_cam", ha="center", fontsize=11, family="monospace")
    axes.text(3.9, -1.38, "p_world = R p_cam + t", ha="center", fontsize=11, family="monospace")
    axes.text(3.9, -1.72, "t and R: position and orientation in the message", ha="center", color=GREY, fontsize=10)


def _draw_body(axes: Axes, at: FloatArray) -> None:
    heading = Rotation.from_euler("z", 105, degrees=True).as_matrix()
    _draw_axes(axes, at, heading, ("x forward", "y left", "z up"), length=1.2)
    middle = flat(at)[0] + 0.35
    axes.text(middle, 2.95, "base_link", ha="center", weight="bold", fontsize=12)
    axes.text(middle, 2.63, "the robot's: in base_pose only", ha="center", color=GREY, fontsize=10)


if __name__ == "__main__":
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "conformodal", "font.family": "DejaVu Sans"}):
        draw().savefig(PICTURE, metadata={"Date": None})
