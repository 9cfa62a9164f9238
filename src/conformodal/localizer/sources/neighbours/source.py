"""The pose source by local regression among the most similar training frames."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import ClassVar, Self

import numpy as np

from conformodal.core.arrays import AnyArray, FloatArray, IntArray
from conformodal.core.progress import stage_of
from conformodal.features.backbone import feature_views
from conformodal.features.projection import Projection
from conformodal.geometry import angle_between_quats, normalise_quat
from conformodal.localizer.error_model import ErrorModel, HeldOutErrors, fit_error_model
from conformodal.localizer.evidence import FrameEvidence
from conformodal.localizer.measurement import PoseMeasurement
from conformodal.localizer.settings import NEIGHBOURS
from conformodal.localizer.sources.registry import SourceAnswer, SourceState, register_source
from conformodal.localizer.sources.source_data import SourceData
from conformodal.localizer.targets import target_scale

from .regression import LocalAnswers, LocalRegression, LocalSettings
from .tuning import LeftOut, fit_local


@register_source
@dataclass(frozen=True, eq=False)
class NeighbourSource:
    """A local regression among `frames` (m,), and its errors on frames that were left out."""

    name: ClassVar[str] = "neighbours"
    local: ClassVar[bool] = False

    regression: LocalRegression
    frames: IntArray
    typical: float  # median novelty of left-out frames
    limit: float  # its upper end
    errors: ErrorModel  # as a function of novelty

    @classmethod
    def fit(cls, data: SourceData, frames: IntArray) -> Self | None:
        """Choose the settings of the regression by leaving pieces out; None where there is only one piece."""
        features, targets, pieces = data.features[frames], data.targets[frames], data.pieces[frames]
        if len(np.unique(pieces)) < 2 or not np.ptp(features, axis=0).any():
            return None
        regression, left_out = fit_local(
            features,
            targets,
            target_scale(targets),
            pieces,
            views=feature_views(features.shape[1]),
            progress=stage_of(data.progress, "neighbours"),
        )
        return cls.of(regression, left_out, frames)

    @classmethod
    def of(cls, regression: LocalRegression, left_out: LeftOut, frames: IntArray) -> Self | None:
        """A source from a regression fitted on `frames` and its left-out answers; None where these are too few."""
        answers, truth = left_out.answers, regression.targets[left_out.rows]
        typical = max(float(np.median(answers.novelty)), 1e-9)
        novelty = _relative(answers, typical)
        same_place = NEIGHBOURS.same_place * float(regression.target_scale[0])
        there = answers.weights >= NEIGHBOURS.least_weight
        values = np.where(there[:, :, None], answers.values, truth[:, None])
        off = np.linalg.norm(values[:, :, :3] - truth[:, None, :3], axis=2)
        angle = angle_between_quats(values[:, :, 3:], truth[:, None, 3:])
        apart = np.where(there, off / same_place + angle, np.inf)
        nearest = np.arange(len(off)), apart.argmin(axis=1)
        unmeasured, alike = np.zeros(len(off)), np.ones(len(off))
        errors = fit_error_model(
            HeldOutErrors(off[nearest], novelty, angle[nearest], novelty, unmeasured, 1 / novelty[:, None], alike),
            same_place,
        )
        limit = max(float(np.quantile(answers.novelty, NEIGHBOURS.usual)), typical)
        return None if errors is None else cls(regression, frames, typical, limit, errors)

    def extended(self, data: SourceData, frames: IntArray, first: int, beyond: IntArray) -> Self:
        """With new frames as references; settings, projection and error model stay."""
        own = self.regression
        regression = replace(
            own,
            references=np.concatenate((own.references, own.projection.apply(data.features[frames]))),
            targets=np.concatenate((own.targets, data.targets[frames])),
        )
        return replace(self, regression=regression, frames=np.append(self.frames, first + frames))

    def answer(self, evidence: FrameEvidence) -> SourceAnswer:
        """One estimate per place that the nearest frames come from."""
        found = self.regression.predict(evidence.features)
        novelty = _relative(found, self.typical)
        rows = zip(found.values, found.weights, novelty.tolist(), strict=True)
        return SourceAnswer(measurements=[self._measurements(*row) for row in rows])

    def _measurements(self, values: FloatArray, weights: FloatArray, novelty: float) -> list[PoseMeasurement]:
        found, beyond = [], max(novelty * self.typical / self.limit, 1.0)
        for k in np.flatnonzero(weights >= NEIGHBOURS.least_weight):
            raw = PoseMeasurement(
                values[k, :3], normalise_quat(values[k, 3:]), novelty, novelty, self.regression.settings.neighbours
            )
            one = self.errors.apply(raw, 1 / novelty)
            # weights are shares of one answer: with more places it is not more probable that all are wrong
            odds = (
                one.inlier_probability / (1 - one.inlier_probability) * beyond**-NEIGHBOURS.distrust * float(weights[k])
            )
            found.append(
                replace(
                    one,
                    inlier_probability=odds / (1 + odds),
                    sigma_m=one.sigma_m * beyond,
                    sigma_rad=one.sigma_rad * beyond,
                )
            )
        return found

    def state(self) -> SourceState:
        """Arrays of the regression, and its settings."""
        own = self.regression
        arrays: dict[str, AnyArray] = {
            "frames": self.frames,
            "offset": own.projection.offset,
            "components": own.projection.components,
            "references": own.references,
            "targets": own.targets,
            "target_scale": own.target_scale,
        }
        numbers = {"typical": self.typical, "limit": self.limit}
        return SourceState(arrays, {"regression": asdict(own.settings), "errors": asdict(self.errors), **numbers})

    @classmethod
    def from_state(cls, state: SourceState) -> Self:
        """The source that was stored."""
        its, settings = state.arrays, state.settings
        regression = LocalRegression(
            Projection(its["offset"], its["components"]),
            its["references"],
            its["targets"],
            its["target_scale"],
            LocalSettings(**settings["regression"]),
        )
        errors = ErrorModel.from_json(settings["errors"])
        return cls(regression, its["frames"], float(settings["typical"]), float(settings["limit"]), errors)


def _relative(answers: LocalAnswers, typical: float) -> FloatArray:
    """(n,) novelty in units of what is typical."""
    return np.maximum(answers.novelty / typical, 1e-3)
