"""Several recordings as one sequence: any mix of layouts, in one world frame."""

from __future__ import annotations

from collections.abc import Sequence as Several
from dataclasses import replace

import numpy as np

from conformodal.core.arrays import BoolArray, FloatArray
from conformodal.geometry import PoseError, Trajectory
from conformodal.geometry.trajectory import concatenate

from .errors import DatasetError
from .lenses import as_camera
from .reading import BETWEEN_RECORDINGS_S
from .recording import Recording


def join_recordings(sequences: Several[Recording], given_test: Several[bool] | None = None) -> Recording:
    """One sequence from one or several, whose poses are in the same world frame.

    Recordings are numbered on. One that does not begin after the end of the one before begins 10 s after it. Images of
    other cameras than the first are brought to the first.

    Parameters
    ----------
    sequences
        At least one; one alone is returned as it is.
    given_test
        Which of them are held out for testing, as the split ``given`` does it; by default, their own lists say it.

    Raises
    ------
    DatasetError
        If there is none, or a data set is named twice.
    """
    if not sequences:
        raise DatasetError("no data set was given, expected at least one")
    if len(sequences) == 1 and given_test is None:
        return sequences[0]
    first = sequences[0]
    parts = [its if its.camera == first.camera else as_camera(its, first.camera) for its in sequences]
    paths = [path for its in parts for path in its.image_paths]
    if len(set(paths)) < len(paths):
        twice = next(path for i, path in enumerate(paths) if path in paths[:i])
        raise DatasetError(f"{twice}: is in two of the data sets; expected recordings without a frame in common")
    starts, numbers, end, number = [], [], -np.inf, 0
    for its in parts:
        begin = float(its.timestamps_s[0])
        starts.append(0.0 if begin > end else end + BETWEEN_RECORDINGS_S - begin)
        end = float(its.timestamps_s[-1]) + starts[-1]
        numbers.append(its.recording - its.recording.min() + number)
        number = int(numbers[-1].max()) + 1
    known = [_moved(its.poses, start) for its, start in zip(parts, starts, strict=True)]
    poses, whole = [its for its in known if its is not None], all(its.truth is not None for its in parts)
    return Recording(
        name=" + ".join(its.name for its in parts),
        image_paths=tuple(paths),
        timestamps_s=np.concatenate([its.timestamps_s + start for its, start in zip(parts, starts, strict=True)]),
        recording=np.concatenate(numbers),
        camera=first.camera,
        truth=concatenate(poses) if whole else None,
        noise=first.noise,
        given_test=_listed(parts, given_test),
        known_poses=concatenate(poses) if poses and not whole else None,
        notes=tuple(note for its, own in zip(parts, sequences, strict=True) for note in (*own.notes,))
        + tuple(note for its, own in zip(parts, sequences, strict=True) for note in its.notes[len(own.notes) :]),
    )


def near_known(poses: Trajectory, known: Trajectory, most_m: float, most_rad: float) -> BoolArray:
    """(n,) whether each of n poses has a known pose within a distance and an angle.

    Raises
    ------
    PoseError
        If nothing is known.
    """
    if not len(known):
        raise PoseError("no pose is known, expected at least one")
    return np.concatenate(
        [_near(poses[i : i + 512], known, most_m, most_rad) for i in range(0, max(len(poses), 1), 512)]
    )


def _near(poses: Trajectory, known: Trajectory, most_m: float, most_rad: float) -> BoolArray:
    apart = np.linalg.norm(poses.positions_xyz[:, None] - known.positions_xyz[None], axis=2)
    alike: FloatArray = np.abs(poses.orientations_quat_wxyz @ known.orientations_quat_wxyz.T)
    return np.asarray(((apart <= most_m) & (alike >= np.cos(most_rad / 2))).any(axis=1))


def _moved(poses: Trajectory | None, start_s: float) -> Trajectory | None:
    return None if poses is None else replace(poses, timestamps_s=poses.timestamps_s + start_s)


def _listed(parts: Several[Recording], given: Several[bool] | None) -> BoolArray | None:
    if given is not None:
        return np.concatenate([np.full(len(its), test) for its, test in zip(parts, given, strict=True)])
    if all(its.given_test is None for its in parts):
        return None
    return np.concatenate(
        [np.zeros(len(its), dtype=bool) if its.given_test is None else its.given_test for its in parts]
    )
