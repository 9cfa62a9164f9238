"""Recognising the frames that a model was trained on, by the bytes of their files, whatever these are called."""

from __future__ import annotations

import hashlib
from collections import defaultdict, deque
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from conformodal.core.arrays import BoolArray, FloatArray, IntArray, Rows, UInt8Array
from conformodal.core.files import read_file
from conformodal.geometry import angle_between_quats
from conformodal.io import Recording

_BYTES = 16  # of a digest
_TOLERANCE = 1e-6  # of positions, relative beyond a metre, and of angles in radians


@dataclass(frozen=True, eq=False)
class FrameIdentities(Rows):
    """Digests and poses of frames; digests of files that cannot be read are zeros, and match nothing."""

    files: UInt8Array  # (n, 16) digests of the images' files
    poses: FloatArray  # (n, 7) position and orientation wxyz; NaN without a pose

    def __len__(self) -> int:
        return len(self.files)

    def known(self, others: FrameIdentities) -> BoolArray:
        """(m,) which of the `others` have the file of one of these frames."""
        mine = {*map(bytes, self.files)} - {bytes(_BYTES)}
        return np.array([bytes(digest) in mine for digest in others.files], dtype=np.bool_)

    def find(self, others: FrameIdentities) -> IntArray:
        """(n,) where the file of each of these frames is among the others; -1 where it is not. Copies go in order."""
        free: defaultdict[bytes, deque[int]] = defaultdict(deque)
        for i in np.flatnonzero(others.files.any(axis=1)).tolist():
            free[bytes(others.files[i])].append(i)
        return np.array([free[row].popleft() if free[row] else -1 for row in map(bytes, self.files)], dtype=np.int64)


def identify(sequence: Recording) -> FrameIdentities:
    """Identities of a recording's frames, from the files as they are, without the recording's noise."""
    with ThreadPoolExecutor(max_workers=2) as pool:
        digests = list(pool.map(_file_digest, sequence.image_paths))
    poses = np.full((len(sequence), 7), np.nan)
    if sequence.truth is not None:
        poses = np.column_stack((sequence.truth.positions_xyz, sequence.truth.orientations_quat_wxyz))
    return FrameIdentities(np.frombuffer(b"".join(digests), np.uint8).reshape(-1, _BYTES), poses)


def _file_digest(path: Path) -> bytes:
    try:
        return hashlib.blake2b(read_file(path), digest_size=_BYTES).digest()
    except OSError:
        return bytes(_BYTES)


def same_poses(one: FloatArray, other: FloatArray) -> BoolArray:
    """(n,) whether two poses (n, 7) are the same but for the last digits of a text file; NaN is any pose."""
    posed = np.isfinite(one + other).all(axis=1)
    a, b = one[posed], other[posed]
    off = np.linalg.norm(a[:, :3] - b[:, :3], axis=1) / np.maximum(1, np.linalg.norm(a[:, :3], axis=1))
    same = np.ones(len(one), dtype=np.bool_)
    same[posed] = (off <= _TOLERANCE) & (angle_between_quats(a[:, 3:], b[:, 3:]) <= _TOLERANCE)
    return same
