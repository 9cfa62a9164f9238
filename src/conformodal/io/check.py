"""What a data set is, and what is wrong with it."""

from __future__ import annotations

import hashlib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np

from conformodal.core.progress import Progress

from .cameras import OF_LAYOUT, OTHER_CAMERA, SCALED
from .decoding import TURNED
from .diagnosis.cameras import UNLIKELY_CAMERA
from .diagnosis.order import diagnose
from .diagnosis.stale import STALE_PICTURES
from .errors import ImageError
from .frame_table import CONVERTED, INTERPOLATED, OWN_SCALE
from .reading import group_by_kind
from .recording import Recording

# A step in time longer than this many usual ones is a gap; one in space, a jump.
_GAP, _JUMP = 3.0, 10.0
_MIN_JUMP_M = 0.05
# What a reader did, and nothing that is wrong.
_NOTES = {SCALED, OTHER_CAMERA, TURNED, INTERPOLATED, CONVERTED, OF_LAYOUT, OWN_SCALE}


@dataclass
class Finding:
    """Something to look at: what it is, how often it occurs, where first, and whether it is wrong or worth knowing."""

    what: str
    count: int
    first: str
    wrong: bool = True


@dataclass
class DatasetCheck:
    """What a data set holds."""

    n_frames: int
    n_recordings: int
    n_poses: int
    width: int
    height: int
    duration_s: float  # from the first frame to the last, recordings apart
    rate_hz: float  # the usual one
    extent_m: list[float] | None  # size of the box around all positions, (3,), in `unit`; None without poses
    path_m: float | None
    unit: str
    findings: list[Finding] = field(default_factory=list)


def check_recording(sequence: Recording, progress: Progress | None = None) -> DatasetCheck:
    """Look at every frame of a data set; decodes all images."""
    names = [path.name for path in sequence.image_paths]
    linked = np.flatnonzero(np.diff(sequence.recording) == 0)
    steps = np.diff(sequence.timestamps_s)[linked]
    usual = float(np.median(steps)) if steps.size else float("nan")
    findings = [
        Finding(what, len(where), where[0], what not in _NOTES) for what, where in group_by_kind(sequence.notes).items()
    ]

    def add(what: str, at: list[int], *, wrong: bool = True) -> None:
        if at:
            findings.append(Finding(what, len(at), names[at[0]], wrong))

    late = (linked[steps > _GAP * usual] + 1).tolist()
    add(f"gap in time of more than {_GAP:g} usual steps before", late, wrong=False)
    extent = path = None
    if sequence.truth is not None:
        positions = sequence.truth.positions_xyz
        lengths = np.linalg.norm(np.diff(positions, axis=0), axis=1)[linked]
        extent, path = np.ptp(positions, axis=0).round(4).tolist(), round(float(lengths.sum()), 4)
        speed = lengths / np.maximum(steps, 1e-9)
        if speed.size:
            jumps = (speed > _JUMP * np.median(speed)) & (lengths > _MIN_JUMP_M)
            add(f"position jumps, more than {_JUMP:g} times as fast as usual, before", (linked[jumps] + 1).tolist())
    told = any(note.what == UNLIKELY_CAMERA for note in sequence.notes)  # which explains poses that do not fit
    if sequence.poses is not None and not told and (cause := diagnose(sequence)):
        findings.append(Finding("poses do not fit the images", 1, str(cause)))
    digests, problems = _decode_all(sequence, progress)
    if problems:
        findings.append(Finding("image cannot be read", len(problems), problems[0]))
    same = [i for i in (linked + 1).tolist() if digests[i] and digests[i] == digests[i - 1]]
    if not any(finding.what == STALE_PICTURES for finding in findings):
        add("the same picture as the frame before", same, wrong=False)
    return DatasetCheck(
        n_frames=len(sequence),
        n_recordings=len(np.unique(sequence.recording)),
        n_poses=0 if sequence.poses is None else len(sequence.poses),
        width=sequence.camera.width,
        height=sequence.camera.height,
        duration_s=round(float(steps.sum()), 4),
        rate_hz=round(1 / usual, 4) if usual > 0 else 0.0,
        extent_m=extent,
        path_m=path,
        unit=sequence.unit,
        findings=findings,
    )


def _decode_all(sequence: Recording, progress: Progress | None) -> tuple[list[bytes], list[str]]:
    """Digests of all images, empty where one cannot be read; and why these cannot."""

    def look(i: int) -> tuple[bytes, str]:
        try:
            return hashlib.sha256(sequence.image(i).tobytes()).digest(), ""
        except ImageError as exc:
            return b"", str(exc)

    digests, problems = [], []
    with ThreadPoolExecutor(max_workers=2) as pool:
        for digest, problem in pool.map(look, range(len(sequence))):
            digests.append(digest)
            problems += [problem] if problem else []
            if progress is not None:
                progress(len(digests), len(sequence))
    return digests, problems
