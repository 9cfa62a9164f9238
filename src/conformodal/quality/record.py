"""What was found of a recording, as JSON takes it."""

from __future__ import annotations

from dataclasses import asdict
from math import isfinite
from typing import Any

import numpy as np

from conformodal.datasets import Sequence

from .advice import Names, describe_quality, record_next
from .examining import RecordingQuality
from .settings import QUALITY

_DIGITS = 4


def quality_record(found: RecordingQuality, sequence: Sequence, *, short: bool = False) -> dict[str, Any]:
    """For ``metrics.json``.

    Parameters
    ----------
    found
        From :func:`~conformodal.quality.examining.examine`.
    sequence
        The recording.
    short
        Whether numbers of single frames are left out.
    """
    names = names_of(found, sequence)
    record: dict[str, Any] = {
        "summary": describe_quality(found),
        "record_next": record_next(found, names),
        "settings": asdict(QUALITY),
        "n_frames": len(sequence),
        "n_with_pose": len(found.posed),
        "n_known": int(found.known.sum()),
        "guarantees": [
            {
                **asdict(guarantee),
                "evidence": guarantee.evidence.name.lower(),
                "least_alpha": guarantee.least_alpha_shown if guarantee.least_alpha < 1 else None,
                "band": None if guarantee.band is None else list(guarantee.band),
            }
            for guarantee in found.guarantees
        ],
    }
    coverage, places = found.coverage, found.ambiguity
    if coverage is not None and found.scale is not None:
        record["scale"] = {"depth_m": found.scale.depth_m, "field_of_view_deg": float(np.degrees(found.scale.fov_rad))}
        record["sparse"] = [
            {**_stretch(asdict(one), sequence), "nearest": _name(found, one.nearest)} for one in coverage.sparse
        ]
        record["fast"] = [_stretch(asdict(one), sequence) for one in coverage.fast]
        record["n_sparse_frames"] = int(coverage.sparse_frames.sum())
        if not short:
            record["change"] = [_number(change) for change in coverage.change.tolist()]
    if places is not None:
        record["ambiguity"] = {
            "n_looked_at": len(places.frames),
            "n_ambiguous": int((places.n_places > 1).sum()),
            "n_unknown": places.n_unknown,
            "mean_intervals": places.mean_intervals,
            "stretches": [_alike(found, _stretch(asdict(one), sequence)) for one in places.stretches],
        }
        if not short:
            record["ambiguity"]["frames"] = places.frames.tolist()
            record["ambiguity"]["n_places"] = places.n_places.tolist()
    return record


def names_of(found: RecordingQuality, sequence: Sequence) -> Names:
    """How its frames and places are called."""
    return Names(sequence, None if found.poses is None else found.poses.positions_xyz)


def _stretch(record: dict[str, Any], sequence: Sequence) -> dict[str, Any]:
    """With the files of its ends, and null for what is infinite."""
    ends = {f"{end}_image": sequence.image_paths[record[end]].name for end in ("first", "last")}
    plain = {k: _number(v) if isinstance(v, float) else v for k, v in record.items()}
    place = [_number(v) for v in record["place_xyz"]]
    return {**plain, **ends, "place_xyz": place}


def _alike(found: RecordingQuality, record: dict[str, Any]) -> dict[str, Any]:
    return {**record, "alike": [[_name(found, a), _name(found, b)] for a, b in record["alike"]]}


def _name(found: RecordingQuality, known: int) -> int | None:
    """Number in the recording of a known frame; null where the recording lacks it."""
    number = int(found.known_names[known]) if known >= 0 else -1
    return number if number >= 0 else None


def _number(value: float) -> float | None:
    return round(value, _DIGITS) if isfinite(value) else None
