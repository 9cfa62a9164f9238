"""A live view in Rerun (extra ``view``), in a window or as a recording."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import numpy as np

from conformodal.core.arrays import FloatArray
from conformodal.core.errors import ConformodalError
from conformodal.core.extras import require_extra
from conformodal.core.words import as_utf8
from conformodal.geometry import Trajectory
from conformodal.io.streams.frames import Frame
from conformodal.localizer.regions import EvidenceType, PoseRegions
from conformodal.pipeline.estimates import Estimate

_MAX_CUBOIDS = 256
_RANGE_M = 100.0  # the whole line is drawn this far around the chosen position
_REGION, _ANSWER, _TRUTH, _CANDIDATE = (86, 180, 233), (0, 114, 178), (120, 120, 120), (230, 159, 0)


class LiveView:
    """Shows a run: image with tracks, places of the image and after motion, candidates, trajectory, p-values, truth.

    Where an image shows no known place, the region is unbounded and no cuboid is drawn; the status says so. `name` is
    that of the source. `spawn` opens Rerun's window; `save` names a file ``.rrd`` and needs no screen.
    """

    def __init__(self, name: str, alpha: object, *, spawn: bool = False, save: Path | None = None) -> None:
        with require_extra("view", "the live view"):
            import rerun  # noqa: PLC0415 - an extra
        self._rr: Any = rerun
        self._stream: Any = rerun.RecordingStream("conformodal", recording_id=None)
        try:
            if save is not None:
                save.parent.mkdir(parents=True, exist_ok=True)
                self._stream.save(str(save))
            if spawn:
                # Rerun looks for its viewer on the path, where an environment that is not activated lacks it
                os.environ["PATH"] = os.pathsep.join((os.environ.get("PATH", ""), str(Path(sys.executable).parent)))
                self._stream.spawn()
        except (OSError, RuntimeError) as exc:
            raise ConformodalError(f"{save if save is not None else 'Rerun'}: cannot be opened: {exc}") from exc
        self._previous: FloatArray | None = None  # chosen position
        self._stream.log("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._stream.log("about", rerun.TextDocument(f"{as_utf8(name)}, alpha = {alpha}"), static=True)

    def log(self, frame: Frame, estimate: Estimate, truth: Trajectory | None = None) -> None:
        """Show a frame and its estimate; `truth` is a trajectory of one, or None."""
        rr = self._rr
        self._stream.set_time("time", duration=frame.timestamp_s)
        entities: dict[str, Any] = {"status": rr.TextLog(as_utf8(estimate.problem) or "reliable")}
        if frame.image is not None:
            entities["camera/image"] = rr.Image(frame.image).compress(jpeg_quality=70)
        if estimate.tracks is not None:
            entities["camera/image/tracks"] = rr.LineStrips2D(np.stack(estimate.tracks, axis=1), colors=_REGION)
        if estimate.region is not None and estimate.pose is not None:
            here = estimate.pose.position_xyz
            unknown = estimate.evidence is EvidenceType.UNKNOWN
            shown = rr.Clear(recursive=False) if unknown else self._cuboids(estimate.region, here, _REGION)
            w, x, y, z = estimate.pose.orientation_quat_wxyz
            entities |= {
                "world/region": shown,
                "world/chosen": rr.Points3D([here], radii=0.04, colors=_ANSWER),
                "world/camera": rr.Transform3D(translation=here, quaternion=rr.Quaternion(xyzw=[x, y, z, w])),
                "plots/places": rr.Scalars(float(estimate.region.n_places[0])),
            }
            if self._previous is not None:
                entities["world/trajectory"] = rr.LineStrips3D([[self._previous, here]], colors=_ANSWER)
            self._previous = here
            if estimate.path_region is not None:
                entities["world/places"] = self._cuboids(estimate.path_region, here, _ANSWER)
            if estimate.candidates is not None:
                labels = [f"{mass:.2f}" for mass in estimate.candidates.weights]
                points = estimate.candidates.positions_xyz
                entities["world/candidates"] = rr.Points3D(points, radii=0.02, colors=_CANDIDATE, labels=labels)
            if truth is not None:
                true = truth.positions_xyz[0]
                entities["world/truth"] = rr.Points3D([true], radii=0.03, colors=_TRUTH)
                entities["plots/error_m"] = rr.Scalars(float(np.linalg.norm(true - here)))
        for name in ("known_p", "position_spread_m"):
            if getattr(estimate, name) is not None:
                entities[f"plots/{name}"] = rr.Scalars(getattr(estimate, name))
        for entity, value in entities.items():
            self._stream.log(entity, value)

    def _cuboids(self, region: PoseRegions, here: FloatArray, colour: tuple[int, int, int]) -> Any:
        places, near = region.places(0)[:_MAX_CUBOIDS], (here[:, None] - _RANGE_M, here[:, None] + _RANGE_M)
        boxes = np.reshape([np.clip(one.box[:3], *near) for one in places if one.box is not None], (-1, 3, 2))
        sizes, labels = np.ptp(boxes, axis=2) / 2, [f"{one.probability:.2f}" for one in places]
        return self._rr.Boxes3D(centers=boxes.mean(axis=2), half_sizes=sizes, colors=colour, labels=labels)

    def close(self) -> None:
        """Everything is written afterwards."""
        self._stream.flush()
        self._stream.disconnect()
