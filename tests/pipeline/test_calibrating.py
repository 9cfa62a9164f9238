from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
from scipy.stats import norm

from conformodal.conformal import QuantileBins
from conformodal.features.extract import FeatureCache
from conformodal.features.local import LocalFeatures
from conformodal.io import SplitKind
from conformodal.localizer.evidence import PoseMeasurement
from conformodal.localizer.localizer import Beliefs
from conformodal.localizer.regions import Support
from conformodal.localizer.sources import registry
from conformodal.localizer.sources.registry import SourceAnswer, register_source
from conformodal.pipeline import calibrate as calibrating
from conformodal.pipeline import calibrate_paths as calibrating_paths
from conformodal.pipeline.calibrate import calibrate_regions, compare_sources
from conformodal.pipeline.config import Calibration, ModelConfig, OdometryError
from conformodal.pipeline.folds import Fold, Folds
from conformodal.pipeline.train import prepare_training_data, train_model
from conformodal.tracking.depths import UNKNOWN_DEPTH
from tests.localizer.conftest import Told

BINS = QuantileBins.from_edges([np.linspace(-4, 4, 21)] * 7)


class SeesAll(Told):
    """A source that looks at every frame that has a pose, whatever it is given."""

    name: ClassVar[str] = "sees-all"

    @classmethod
    def fit(cls, data, frames):
        return cls(np.arange(len(data.targets)))

    def answer(self, evidence):
        return SourceAnswer(measurements=[[]] * len(evidence))


@pytest.mark.parametrize("calibrate_on", [Calibration.FRAMES, Calibration.STRETCHES])
def test_a_source_is_not_calibrated_on_frames_that_it_has_seen(sequence, small_world, calibrate_on, monkeypatch):
    monkeypatch.setattr(registry, "_KINDS", dict(registry._KINDS))  # known in this test alone
    register_source(SeesAll)
    config = ModelConfig(alpha=0.2, sources=(SeesAll.name,), calibrate_on=calibrate_on)
    data = prepare_training_data(sequence, config, FeatureCache(small_world.cache))
    with pytest.raises(OdometryError, match=r"pose source 'sees-all' has seen frame \d+, and (\d+) of the \1 frames"):
        train_model(data, config)


def hypothesis_at(targets, cells):
    return Support(None, np.zeros(1, int), cells.encode(np.clip(targets, -3.9, 3.9)[None]), np.zeros(1))


class Claims:
    """Normal beliefs with errors of one size that claim another; an image's features are its targets."""

    sources = ()
    local = False
    cells = QuantileBins.from_edges([np.linspace(-8, 8, 161)] * 7)

    def __init__(self, error, claimed):
        self.error, self.claimed = error, claimed

    def beliefs(self, evidence):
        rng = np.random.default_rng(int(1e6 * np.abs(evidence.features).sum()))
        noise = rng.normal(0, self.error, (len(evidence), 7))
        none = np.zeros(len(evidence), dtype=bool)
        return SimpleNamespace(means=evidence.features + noise, recognised=none, recognition=0.0 * none)

    def supports(self, beliefs):
        return [hypothesis_at(mean, self.cells) for mean in beliefs.means]

    def marginals_by_part(self, beliefs):
        edges = self.cells.edges_[0]
        mass = np.diff(norm.cdf((edges - beliefs.means[..., None]) / self.claimed), axis=-1)
        mass /= mass.sum(axis=-1, keepdims=True)
        yield slice(0, len(beliefs.means)), list(mass.transpose(1, 0, 2))


@pytest.mark.parametrize(("claimed", "overconfident"), [(0.5, True), (0.8, False)])
def test_smaller_errors_that_claim_half_the_spread_are_reported(claimed, overconfident):
    """A final model with 20 % smaller errors keeps the guarantee only if it claims no smaller spread than it has."""
    targets = np.random.default_rng(0).uniform(-2, 2, (400, 7))
    data = SimpleNamespace(features=targets, targets=targets, bins_of=lambda frames: BINS, depth=UNKNOWN_DEPTH)
    order, parts = np.arange(280), np.arange(280) // 56
    folds = Folds([Fold(order[parts != k], order[parts == k]) for k in range(5)], order, np.arange(400) // 7, order)
    localizers = [Claims(1.0, 1.0)] * 5
    rules = calibrate_regions(data, folds, localizers, None, ModelConfig(score="hpd"), {}).rules
    found = compare_sources(data, localizers, Claims(0.8, claimed), None, rules, np.arange(280, 400))
    assert found.n_frames == 120
    by_model, by_folds = found.covered
    assert by_folds > 0.85
    assert (by_model < 0.85) == overconfident
    assert found.overconfident == overconfident
    assert found.larger > 0.5 or not overconfident
    assert f"hold {by_model:.3f} of the poses" in found.describe()


class ToldBeliefs:
    """Beliefs about frames `rows`, to which posteriors add nothing."""

    def __init__(self, rows):
        self.rows, self.mixtures = rows, [None] * len(rows)

    def part(self, rows):
        return ToldBeliefs(self.rows[rows])

    def after(self, posteriors):
        assert len(posteriors) == len(self.rows)
        return self


def test_lost_frames_do_not_calibrate_path_regions(monkeypatch):
    unit, n = np.repeat(np.arange(5), (100, 40, 14, 6, 1)), 161
    score = np.arange(n) / n  # tells the frame
    posterior = SimpleNamespace(lost=False, unseen_s=0.3)
    lost = SimpleNamespace(lost=True, unseen_s=9.0)

    stubs = {
        "Observations": lambda candidates, *_, known: SimpleNamespace(candidates=candidates),
        "filter_posteriors": lambda seen, prior: [posterior] * len(seen.candidates),
        "hindsight_posteriors": lambda seen, prior, forward: [lost, *forward[1:]],
        "squared_error": lambda posterior, mixture, target, prior: 6.0 if posterior.lost else 3.0,
        "score_beliefs": lambda rule, localizer, beliefs, targets: np.repeat(score[beliefs.rows, None], 7, axis=1),
    }
    for name, stub in stubs.items():
        monkeypatch.setattr(calibrating_paths, name, stub)
    sequence = SimpleNamespace(recording=unit, timestamps_s=np.arange(n))
    localizer = SimpleNamespace(cells=BINS, supports=lambda its: [SimpleNamespace(out_of_range=False)] * len(its.rows))
    every = np.ones(n, dtype=bool)
    overall = SimpleNamespace(alpha=0.1, units_=unit, bins=BINS)
    # every third image is like no known place
    rules = SimpleNamespace(overall=overall, shows_known_place=every, known_p=(np.arange(n) % 3) / 2, level=0.1)
    folds = Folds([Fold(np.arange(0), np.arange(n))], np.arange(0), unit, unit)
    its = SimpleNamespace(rules=rules, beliefs=[ToldBeliefs(np.arange(n))])
    data = SimpleNamespace(sequence=sequence, targets=np.zeros((n, 7)), split=SimpleNamespace(kind=SplitKind.BLOCKS))
    paths = calibrating_paths.calibrate_paths(data, folds, [localizer], its, None, [None] * n)
    assert {path.longest_gap_s for path in paths.values()} == {0.3}
    online, hindsight = (paths[path].calibration for path in ("online", "hindsight"))
    np.testing.assert_array_equal(np.sort(online.scores_[:, 0]), score)
    assert {error for path in paths.values() for error in path.squared} == {3.0}
    np.testing.assert_array_equal(paths["online"].novel[np.argsort(online.scores_[:, 0])], np.arange(n) % 3 == 0)
    first = np.array([0, 100, 140, 154, 160])  # lost in hindsight
    np.testing.assert_array_equal(np.sort(hindsight.scores_[:, 0]), np.delete(score, first))
    assert float(hindsight.weight) == pytest.approx((np.array([100, 40, 14, 6]) - 1) @ (1 / np.array([100, 40, 14, 6])))


class Rolled:
    """Turns an image by a tenth of where the camera was; upright, only the first frame of a stretch is recognised."""

    carrying_source = None

    def turn_for(self, position_xyz, quat_wxyz):
        return 0.1 * position_xyz[0]

    def beliefs(self, evidence):
        [seen] = evidence.local_features
        frame, turned = seen.quality.astype(int)
        pose = PoseMeasurement(np.array([frame, 0, 0]), np.array([1.0, 0, 0, 0]), 0.1, 0.1, 50, 0.99)
        recognised = turned or frame in (1, 5)
        return Beliefs([np.full((1, 2), frame)], [("upright", "turned")[turned]], [[pose] if recognised else []])


def test_held_out_stretches_are_processed_as_streams(monkeypatch):
    """As in a run, an image is turned by the pose of the frame before."""
    turned = []

    def features_of(frame, turned):
        return LocalFeatures(np.zeros((0, 2)), np.zeros((0, 64), np.int8), np.zeros(0), np.array([frame, turned]))

    def turned_features(sequence, frame, detector, turn_rad, upright):
        turned.append((frame, round(turn_rad, 3), *upright.quality))
        return features_of(frame, 1)

    monkeypatch.setattr(calibrating, "turned_features", turned_features)
    grey = np.zeros((4, 4), np.uint8)
    data = SimpleNamespace(
        local_features=lambda frames: [features_of(frames[0], 0)],
        sequence=SimpleNamespace(camera=None, image=lambda i: grey, timestamps_s=np.arange(8.0)),
        detector=SimpleNamespace(rotation_invariant=False, n_parts=1),
        features=np.zeros((8, 1)),
    )
    held_out, units = np.array([1, 2, 3, 5, 6, 7]), np.array([1, 1, 1, 1, 0, 0, 0, 0])
    found = calibrating.beliefs_of_streams(
        units, dict.fromkeys(range(8)), calibrating.HeldOutStreams(data, held_out, Rolled(), carries=True)
    )
    # a turned image gives its pose anew; the first of a stretch is upright
    assert sorted(turned) == [(2, 0.1, 2, 0), (3, 0.2, 3, 0), (6, 0.5, 6, 0), (7, 0.6, 7, 0)]
    assert found.mixtures == ["upright", "turned", "turned"] * 2
    np.testing.assert_array_equal(found.proba[0][:, 0], held_out)
    assert [its[0].position_xyz[0] for its in found.estimates] == held_out.tolist()
