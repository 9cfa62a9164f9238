"""Recognising the frames that a model was trained on, by pixels and poses whatever the names of their files."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from conformodal.core.arrays import BoolArray, FloatArray, IntArray, Rows, UInt8Array
from conformodal.geometry import angle_between_quats
from conformodal.io import ImageError, Recording, read_image

_BYTES = 16  # of a digest
_NOTHING = bytes(_BYTES)
_BLANK = bytes(_BYTES // 2)  # that digests of images of one colour begin with
# Poses that went through the text of another layout lose their last digits: to 1e-9, relative in some.
_TOLERANCE_M, _TOLERANCE_RAD = 1e-6, 1e-6
# Digests of pixels by digests of files: a process that trains many models on a data set decodes it once for them.
_DECODED: dict[bytes, bytes] = {}
_MOST_DECODED = 200_000


@dataclass(frozen=True, eq=False)
class FrameMatches:
    """Indices (n,) in a sequence of frames that match known frames; -1 without a match."""

    at: IntArray  # same pixels and, if both have one, same pose; no two known frames share a match
    moved: IntArray  # where `at` is -1: same pixels, another pose


@dataclass(frozen=True, eq=False)
class FrameIdentities(Rows):
    """Digests and poses by which frames are recognised; digests of files that cannot be read are zeros, no match."""

    files: UInt8Array  # (n, 16) digests of the image's file
    pixels: UInt8Array  # (n, 16) digests of its pixels
    poses: FloatArray  # (n, 7) position and orientation wxyz; NaN without a pose

    def __len__(self) -> int:
        return len(self.pixels)

    def known(self, others: FrameIdentities) -> BoolArray:
        """(m,) which of the `others` have the pixels of one of these frames; images of one colour tell nothing."""
        mine = {row.tobytes() for row in self.pixels} - {_NOTHING}
        rows = [row.tobytes() for row in others.pixels]
        return np.array([row in mine and not row.startswith(_BLANK) for row in rows], dtype=bool)

    def find(self, others: FrameIdentities) -> FrameMatches:
        """Find each of these frames among the `others`: by its pixels, and by its pose where both have one.

        Frames with the same pixels are told apart by their poses; those with the same pose as well are taken in order.
        """
        at, moved = np.full(len(self), -1), np.full(len(self), -1)
        alike: dict[bytes, list[int]] = defaultdict(list)
        for k, row in enumerate(self.pixels):
            alike[row.tobytes()].append(k)
        left = []
        for i, row in enumerate(others.pixels):
            digest = row.tobytes()
            if digest == _NOTHING or digest not in alike:
                continue
            free = [k for k in alike[digest] if at[k] < 0]
            same = next((k for k in free if _same_pose(self.poses[k], others.poses[i])), None)
            if same is None:
                left.append((i, digest))
            else:
                at[same] = i
        for i, digest in left:
            for k in alike[digest]:
                if at[k] < 0 and moved[k] < 0:
                    moved[k] = i
        return FrameMatches(at, moved)


def identify(sequence: Recording, known: FrameIdentities | None = None) -> FrameIdentities:
    """Identities of a sequence's frames, from the files as they are, without the sequence's noise.

    Files that are byte for byte those of `known` frames are not decoded, so another decoder's rounding does not matter.
    """
    decoded = (
        {} if known is None else {f.tobytes(): p.tobytes() for f, p in zip(known.files, known.pixels, strict=True)}
    )
    decoded.pop(_NOTHING, None)
    n = len(sequence)
    found = np.zeros((2, n, _BYTES), dtype=np.uint8)
    with ThreadPoolExecutor(max_workers=2) as pool:
        digests = pool.map(lambda path: _digests(path, decoded), sequence.image_paths)
        for i, (of_file, of_pixels) in enumerate(digests):
            found[0, i], found[1, i] = np.frombuffer(of_file, np.uint8), np.frombuffer(of_pixels, np.uint8)
    poses = np.full((n, 7), np.nan)
    if sequence.truth is not None:
        poses = np.column_stack((sequence.truth.positions_xyz, sequence.truth.orientations_quat_wxyz))
    return FrameIdentities(found[0], found[1], poses)


def data_digest(sequence: Recording) -> str:
    """Digest of everything in a data set that results depend on."""
    own = identify(sequence)
    digest = hashlib.sha256(f"{sequence.camera} {sequence.noise}".encode())
    for array in (own.pixels, own.poses, sequence.timestamps_s, sequence.recording):
        digest.update(np.ascontiguousarray(array).tobytes())
    for path in sequence.image_paths:  # results name frames, and a frame's noise is drawn by its name
        digest.update(path.name.encode() + b"\0")
    return digest.hexdigest()


def _digests(path: Path, decoded: dict[bytes, bytes]) -> tuple[bytes, bytes]:
    """Digests of an image's file and of its pixels."""
    try:
        of_file = hashlib.blake2b(path.read_bytes(), digest_size=_BYTES).digest()
        of_pixels = decoded.get(of_file) or _DECODED.get(of_file)
        if of_pixels is None:
            image = read_image(path)
            digest = hashlib.blake2b(str(image.shape).encode(), digest_size=_BYTES)
            content, pixel = image.tobytes(), image[0, 0].tobytes()
            digest.update(content)
            blank = content == pixel * (len(content) // len(pixel))
            of_pixels = _BLANK + digest.digest()[len(_BLANK) :] if blank else digest.digest()
            if len(_DECODED) >= _MOST_DECODED:
                _DECODED.clear()
            _DECODED[of_file] = of_pixels
    except (OSError, ImageError):
        return _NOTHING, _NOTHING
    return of_file, of_pixels


def _same_pose(a: FloatArray, b: FloatArray) -> bool:
    if np.isnan(a).any() or np.isnan(b).any():
        return True
    near = np.linalg.norm(a[:3] - b[:3]) <= _TOLERANCE_M * max(1.0, float(np.linalg.norm(a[:3])))
    return bool(near and angle_between_quats(a[3:], b[3:]) <= _TOLERANCE_RAD)
