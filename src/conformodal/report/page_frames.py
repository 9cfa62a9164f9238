"""What the page is told of each frame of a run."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from itertools import islice, product
from typing import Any

import numpy as np
import numpy.typing as npt

from conformodal.core.arrays import FloatArray
from conformodal.model.region_rules import EvidenceType
from conformodal.poses import Trajectory, orientation_errors_deg, position_errors_m

Interval = list[float | None]
PlaceBox = tuple[list[Interval], float | None]
_MOST_BOXES = 64  # of a region that is a product
AXES = "xyz"
_UNKNOWN = EvidenceType.UNKNOWN.name.lower()


@dataclass(frozen=True, eq=False)
class Paths:
    """Trajectories of the same frames.

    Attributes
    ----------
    answer
        Of the run.
    truth, classical, online
        The true one, the classical regressor's, and ours as a robot gets it; None where it is not known.
    """

    answer: Trajectory
    truth: Trajectory | None = None
    classical: Trajectory | None = None
    online: Trajectory | None = None

    def errors(self) -> tuple[FloatArray, FloatArray] | None:
        """Metres and degrees between the answer and the truth, (n,) each."""
        if self.truth is None:
            return None
        return position_errors_m(self.answer, self.truth), orientation_errors_deg(self.answer, self.truth)


@dataclass(frozen=True, eq=False)
class PageFrame:
    """One frame: its region of positions, its chosen pose, and what is known of the truth.

    Attributes
    ----------
    name, time_s, reliable, motion, known_p, evidence, place_p
        As in the region's record; the last three are None in runs of earlier versions.
    position_xyz, quat_wxyz
        Of the chosen pose.
    intervals
        For each of x, y and z; None is an end that has no bound.
    places, path_places
        Boxes of positions of the image's region and of the one after motion, most probable first: intervals along x, y
        and z, and the probability, None if it is not known. `path_places` is None where the model has no such region.
    truth_xyz, error_m, error_deg
        None where the truth is not known.
    classical_xyz
        Of the classical regressor, if there is one.
    """

    name: str
    time_s: float
    reliable: bool
    motion: str
    known_p: float | None
    evidence: str | None
    position_xyz: npt.NDArray[np.float64]
    quat_wxyz: npt.NDArray[np.float64]
    intervals: list[list[Interval]]
    places: list[PlaceBox]
    path_places: list[PlaceBox] | None = None
    truth_xyz: npt.NDArray[np.float64] | None = None
    error_m: float | None = None
    error_deg: float | None = None
    classical_xyz: npt.NDArray[np.float64] | None = None
    place_p: float | None = None

    @property
    def unknown(self) -> bool:
        """Whether the image shows no known place."""
        return self.evidence == _UNKNOWN

    @property
    def whole(self) -> bool:
        """Whether the region holds every position: there is no box to draw."""
        return all(parts == [[None, None]] for parts in self.intervals)

    @property
    def unbounded(self) -> list[str]:
        """Axes along which an interval has no bound."""
        return [axis for axis, parts in zip(AXES, self.intervals, strict=True) if any(None in part for part in parts)]

    @property
    def n_places(self) -> int:
        """How many boxes the region of positions consists of."""
        return len(self.places)

    @property
    def size_m(self) -> float | None:
        """Root of the summed squared lengths of the position's sets; None without a bound."""
        if self.unbounded:
            return None
        return float(np.linalg.norm([sum(lengths(parts)) for parts in self.intervals]))

    def holds(self, place_xyz: npt.NDArray[np.float64]) -> bool:
        """Whether the region holds a position."""
        return any(
            all(
                (low is None or low <= v) and (high is None or v <= high)
                for (low, high), v in zip(box, place_xyz, strict=True)
            )
            for box, _ in self.places
        )

    def as_json(self, text: str, image: bytes | None) -> dict[str, Any]:
        """What the page's script reads; short names, because there are a thousand frames."""
        frame: dict[str, Any] = {
            "n": self.name,
            "t": round(self.time_s, 4),
            "ok": self.reliable,
            "m": self.motion,
            "p": _rounded(self.position_xyz),
            "q": _rounded(self.quat_wxyz),
            "iv": [[[None if e is None else round(e, 4) for e in part] for part in parts] for parts in self.intervals],
            "bx": _boxes(self.places),
            "size": None if self.size_m is None else round(self.size_m, 4),
            "whole": self.whole,
            "say": text,
        }
        if self.path_places is not None:
            frame["pb"] = _boxes(self.path_places)
        if self.evidence is not None:
            frame |= {"kp": self.known_p, "ev": self.evidence}
        if self.place_p is not None:
            frame["pp"] = self.place_p
        if image is not None:
            frame["img"] = base64.b64encode(image).decode()
        if self.classical_xyz is not None:
            frame["classical"] = _rounded(self.classical_xyz)
        if self.truth_xyz is not None and self.error_m is not None and self.error_deg is not None:
            frame |= {"truth": _rounded(self.truth_xyz), "held": self.holds(self.truth_xyz)}
            frame |= {"err": round(self.error_m, 5), "deg": round(self.error_deg, 4)}
            if self.classical_xyz is not None:
                frame["cerr"] = round(float(np.linalg.norm(self.classical_xyz - self.truth_xyz)), 5)
        return frame


def page_frame(i: int, record: dict[str, Any], paths: Paths, errors: tuple[FloatArray, FloatArray] | None) -> PageFrame:
    """The i-th frame of a run, from the record of its region; `errors` are those of :meth:`Paths.errors`."""
    intervals = [record["intervals"][axis] for axis in AXES]
    return PageFrame(
        name=record["frame"],
        time_s=record["timestamp_s"],
        reliable=record["reliable"],
        motion=record["motion"],
        known_p=record.get("known_p"),
        evidence=record.get("evidence"),
        position_xyz=paths.answer.positions_xyz[i],
        quat_wxyz=paths.answer.orientations_quat_wxyz[i],
        intervals=intervals,
        places=_places(record.get("places")) or [([*box], None) for box in islice(product(*intervals), _MOST_BOXES)],
        path_places=None if record.get("path_places") is None else _places(record["path_places"]),
        truth_xyz=None if paths.truth is None else paths.truth.positions_xyz[i],
        error_m=None if errors is None else float(errors[0][i]),
        error_deg=None if errors is None else float(errors[1][i]),
        classical_xyz=None if paths.classical is None else paths.classical.positions_xyz[i],
        place_p=record.get("place_p"),
    )


def _places(places: list[dict[str, Any]] | None) -> list[PlaceBox]:
    """Boxes of positions; those of places that differ in orientation alone are one."""
    found: dict[str, PlaceBox] = {}
    for place in places or []:
        box = place["box"][:3]
        before = found.get(str(box), (box, 0.0))[1] or 0.0
        found[str(box)] = box, before + place["p"]
    return sorted(found.values(), key=lambda one: -(one[1] or 0.0))


def _boxes(places: list[PlaceBox]) -> list[list[Any]]:
    return [[*([None if e is None else round(e, 4) for e in part] for part in box), p] for box, p in places]


def lengths(parts: list[Interval]) -> list[float]:
    """Of intervals; infinite without a bound."""
    return [float("inf") if low is None or high is None else high - low for low, high in parts]


def _rounded(values: npt.NDArray[np.float64]) -> list[float]:
    return [round(float(v), 4) for v in values]
