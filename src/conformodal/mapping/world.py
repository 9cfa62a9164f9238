"""Where the world of a map lies: its scale and axes, from a known length, known positions or the cameras' up."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import NamedTuple

import numpy as np

from conformodal.core.arrays import FloatArray
from conformodal.core.words import counted
from conformodal.geometry.metrics import Similarity, umeyama
from conformodal.io.reading import number, parse_lines, tokens

from .clips import Clip
from .settings import MapError

METRES, MAP_UNITS = "m", "units"
USUAL_DEPTH = 2.0  # map units from the cameras to what they see: about as many as metres in a room
_MIN_POSITIONS, _COLLINEAR = 3, 0.02  # second to first spread of positions, below which they lie on a line
_LEVEL = 0.5  # of the spread of the cameras' sideways axes, below which they do not tell a plane
_APART = 1e-6  # of the extent of the map


class Up(StrEnum):
    """Which way of the images is usually up in the world."""

    TOP = "top"
    BOTTOM = "bottom"
    LEFT = "left"
    RIGHT = "right"
    FRONT = "front"
    BACK = "back"


_AXES = {
    Up.TOP: (0, -1, 0),
    Up.BOTTOM: (0, 1, 0),
    Up.LEFT: (-1, 0, 0),
    Up.RIGHT: (1, 0, 0),
    Up.FRONT: (0, 0, 1),
    Up.BACK: (0, 0, -1),
}


class KnownLength(NamedTuple):
    """A length between the cameras of two frames."""

    first: str
    second: str
    metres: float


@dataclass(frozen=True, eq=False)
class Placement:
    """What is known of scale and axes; at most one of length and positions."""

    length: KnownLength | None = None
    positions_file: Path | None = None
    up: Up = Up.TOP

    def check(self) -> None:
        """Refuse, before any work, what cannot be right."""
        if self.length is not None and self.positions_file is not None:
            raise MapError("--known-length and --positions both give the scale; leave out one of them")
        if self.length is not None:
            first, second, metres = self.length
            if not 0 < metres < np.inf:
                raise MapError(f"--known-length: the length must be a positive number of metres, got {metres:g}")
            if first == second:
                raise MapError(f"--known-length: needs two images, got {first} twice")
        if self.positions_file is not None:
            read_positions(self.positions_file)

    def frames(self, clips: Sequence[Clip]) -> dict[str, str]:
        """Files of the frames that are named, by their names; refuses names that no frame has, or several."""
        names: Sequence[str] = ()
        if self.length is not None:
            names = self.length[:2]
        elif self.positions_file is not None:
            names = list(read_positions(self.positions_file))
        files = {name: frame_named(name, clips, self.source) for name in names}
        if len(set(files.values())) < len(files):
            first, second = next((a, b) for a in files for b in files if a < b and files[a] == files[b])
            raise MapError(f"{self.source}: {first} and {second} are one image, expected each once")
        return files

    @property
    def source(self) -> str:
        """Where names come from, for messages."""
        return "--known-length" if self.length is not None else str(self.positions_file)


@dataclass(frozen=True, eq=False)
class World:
    """The world that a map is brought to.

    Attributes
    ----------
    similarity
        From the map to the world.
    unit
        Of lengths: ``m``, or ``units``, the map's own.
    residuals_m
        (n,) distances of known positions from those of the map, after the similarity; empty without.
    axes
        What the axes are, for people.
    """

    similarity: Similarity
    unit: str
    residuals_m: FloatArray
    axes: str


def frame_named(name: str, clips: Sequence[Clip], what: str) -> str:
    """The file of the frame that a user calls so: as it was called in its source, or as it is written."""
    named = {
        image: source
        for clip in clips
        for image, source in zip(clip.images, clip.source_names, strict=True)
        if name in (source, Path(source).stem, image, f"{Path(clip.source).name}/{source}")
    }
    if len(named) > 1:
        raise MapError(f"{what}: {name} is the name of {len(named)} frames, such as {' and '.join(list(named)[:2])}")
    if not named:
        example = clips[0].source_names[0]
        raise MapError(f"{what}: no frame is called {name}, expected a name such as {example}")
    return next(iter(named))


def read_positions(path: Path) -> dict[str, FloatArray]:
    """Positions (3,) in metres by image, of lines ``image x y z``; at least three that are not on a line."""

    def parse(line: str) -> tuple[str, FloatArray]:
        name, *values = tokens(line)
        position = np.array([number(value) for value in values])
        if position.shape != (3,) or not np.isfinite(position).all():
            raise ValueError("not a position")
        return name, position

    rows = parse_lines(path, parse, "'image x y z' in metres")
    names = [name for name, _ in rows]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise MapError(f"{path}: gives {twice} twice, expected each image once")
    if len(rows) < _MIN_POSITIONS:
        raise MapError(f"{path}: holds {counted(len(rows), 'position')}, expected three or more that are not on a line")
    _refuse_line(np.array([position for _, position in rows]), f"{path}: its positions")
    return dict(rows)


def _refuse_line(positions: FloatArray, what: str) -> None:
    """Refuse positions (n, 3) on a line, about which the world could turn."""
    spread = np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False)
    if spread[1] <= _COLLINEAR * spread[0]:
        raise MapError(f"{what} lie on a line or in one place, expected three or more that do not")


def place_world(poses: Mapping[str, FloatArray], clips: Sequence[Clip], placement: Placement, depth: float) -> World:
    """The similarity from a map to the world; `poses` are ``T_world_cam`` (4, 4) by file.

    `depth` is that at which the cameras usually see points of the map, for its own unit.
    """
    files = placement.frames(clips)
    named = {name: _position(poses, file, name, placement.source) for name, file in files.items()}
    if placement.positions_file is not None:
        return _by_positions(named, placement.positions_file)
    turn = upright(np.array([pose[:3, :3] for pose in poses.values()]), placement.up)
    scale, unit = USUAL_DEPTH / depth, MAP_UNITS
    if placement.length is not None:
        scale, unit = _scale_of(named, poses, placement.length), METRES
    first = next(iter(poses.values()))[:3, 3]
    return World(Similarity(turn, -scale * turn @ first, scale), unit, np.zeros(0), "z up, by the cameras")


def _scale_of(named: Mapping[str, FloatArray], poses: Mapping[str, FloatArray], length: KnownLength) -> float:
    """Metres per unit of the map, from positions (3,) of the two named frames."""
    apart = float(np.linalg.norm(named[length.second] - named[length.first]))
    positions = np.array([pose[:3, 3] for pose in poses.values()])
    if apart <= _APART * float(np.ptp(positions, axis=0).max()):
        raise MapError(f"--known-length: the cameras of {length.first} and {length.second} are in one place")
    return length.metres / apart


def _by_positions(named: Mapping[str, FloatArray], path: Path) -> World:
    """The world of a file of positions, from those (3,) of the named frames in the map."""
    given = read_positions(path)
    inside, outside = np.array([named[name] for name in given]), np.array(list(given.values()))
    _refuse_line(inside, f"{path}: in the map, its positions")
    similarity = umeyama(inside, outside, with_scale=True)
    residuals = np.linalg.norm(similarity.scale * inside @ similarity.R.T + similarity.t - outside, axis=1)
    return World(similarity, METRES, residuals, f"those of {path.name}")


def _position(poses: Mapping[str, FloatArray], file: str, name: str, what: str) -> FloatArray:
    if file not in poses:
        raise MapError(f"{what}: the map has no pose of {name}; name another image")
    return poses[file][:3, 3]


def upright(rotations: FloatArray, up: Up = Up.TOP) -> FloatArray:
    """The rotation (3, 3) that turns the world of cameras (n, 3, 3) so that z is up.

    People hold cameras level: up is across the axes to the side of all images, and near the mean of their tops. Where
    cameras hardly turn, only the latter tells. Images whose up is not their top are turned before.
    """
    ups = rotations @ np.array(_AXES[up], dtype=np.float64)
    mean = ups.mean(axis=0)
    mean = mean / np.linalg.norm(mean) if np.linalg.norm(mean) > 1e-9 else np.array([0.0, 0.0, 1.0])
    if up in (Up.TOP, Up.BOTTOM, Up.LEFT, Up.RIGHT):
        side = np.cross(np.array(_AXES[up], dtype=np.float64), [0.0, 0.0, 1.0])
        sides = rotations @ side
        values, vectors = np.linalg.eigh(sides.T @ sides / len(sides))
        level = vectors[:, 0] * np.sign(vectors[:, 0] @ mean)
        if values[0] < _LEVEL * values[1] and level @ mean > np.cos(np.radians(45)):
            mean = level
    return _turn_to_z(mean)


def _turn_to_z(up: FloatArray) -> FloatArray:
    """The shortest rotation (3, 3) that takes a unit vector to z."""
    across = np.cross(up, [0.0, 0.0, 1.0])
    sine, cosine = float(np.linalg.norm(across)), float(up[2])
    if sine < 1e-9:
        return np.eye(3) if cosine > 0 else np.diag([1.0, -1.0, -1.0])
    x, y, z = across / sine
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + sine * cross + (1 - cosine) * cross @ cross)
