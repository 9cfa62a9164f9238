"""Every pose source: which frames it looks at, that it can be stored, and that others can be added."""

import pickle
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest

from conformodal.features.local import LocalFeatures
from conformodal.localizer import LocalizationError
from conformodal.localizer.evidence import FrameEvidence, PoseMeasurement
from conformodal.localizer.localizer import Localizer
from conformodal.localizer.sources import registry
from conformodal.localizer.sources.head import HeadSource
from conformodal.localizer.sources.registry import SourceAnswer, SourceState, find_source, register_source
from conformodal.pipeline.config import OdometryError
from conformodal.pipeline.store import ModelFileError, load_model, save_model
from tests.localizer.conftest import Told
from tests.small_model import small_model


def same_answers(one, other):
    """Whether two answers are the same to the last bit."""
    assert (one.proba is None) == (other.proba is None)
    for p, q in zip(one.proba or [], other.proba or [], strict=True):
        np.testing.assert_array_equal(p, q)
    assert [len(its) for its in one.measurements] == [len(its) for its in other.measurements]
    for its, others in zip(one.measurements, other.measurements, strict=True):
        for a, b in zip(its, others, strict=True):
            for name in PoseMeasurement.__dataclass_fields__:
                np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def same_states(one, other):
    assert one.settings == other.settings
    assert one.arrays.keys() == other.arrays.keys()
    for name in one.arrays:
        np.testing.assert_array_equal(one.arrays[name], other.arrays[name])
        assert one.arrays[name].dtype == other.arrays[name].dtype


def test_a_name_belongs_to_one_kind(monkeypatch):
    monkeypatch.setattr(registry, "_KINDS", dict(registry._KINDS))
    assert register_source(HeadSource) is HeadSource  # the same class again is no other

    class Impostor:
        name = "head"
        local = False

    with pytest.raises(LocalizationError, match="pose source 'head' already: HeadSource"):
        register_source(Impostor)
    assert find_source("head") is HeadSource
    with pytest.raises(LocalizationError, match=r"one of head, landmarks, .*got 'Head'"):
        find_source("Head")
    for name in ("", "head.x", "a b", "1", "a/b"):  # which could name another source's arrays
        with pytest.raises(LocalizationError, match="must be of letters"):
            register_source(type("Odd", (HeadSource,), {"name": name}))


@pytest.mark.parametrize("wrong", [np.nan, 1e9])
def test_a_head_looks_at_its_own_frames_and_at_no_other(data_of, spoilt, wrong):
    data = data_of()
    frames = np.flatnonzero(np.arange(240) % 5 != 0)
    clean, poisoned = (HeadSource.fit(its, frames) for its in (data, spoilt(data, frames, wrong)))
    np.testing.assert_array_equal(clean.frames, frames)
    same_states(clean.state(), poisoned.state())
    queries = FrameEvidence(data.features[::7])
    same_answers(clean.answer(queries), poisoned.answer(queries))
    # and the frames are not the same by chance: others say something else
    fewer = HeadSource.fit(data, frames[:-20])
    assert any(not np.array_equal(v, fewer.state().arrays[k]) for k, v in clean.state().arrays.items() if k != "frames")


@dataclass(frozen=True, eq=False)
class MeanSource(Told):
    """Says of every image that it was taken in the middle of all that it has seen."""

    name: ClassVar[str] = "mean-of-the-tests"
    place: np.ndarray | None = None

    @classmethod
    def fit(cls, data, frames):
        return cls(frames, place=data.targets[frames].mean(axis=0))

    def answer(self, evidence):
        quat = self.place[3:] / np.linalg.norm(self.place[3:])
        return SourceAnswer(measurements=[[PoseMeasurement(self.place[:3], quat, 0.5, 0.5, 1, 0.25)]] * len(evidence))

    def state(self):
        return SourceState({"place": self.place, "frames": self.frames})

    @classmethod
    def from_state(cls, state):
        return cls(**state.arrays)


def test_custom_source_is_fitted_used_saved_and_loaded(data_of, tmp_path, monkeypatch):
    monkeypatch.setattr(registry, "_KINDS", dict(registry._KINDS))  # known in this test alone
    assert register_source(MeanSource) is MeanSource  # also a decorator
    data, frames = data_of(100), np.arange(80)
    localizer = Localizer.fit_each(data, [frames], ("head", MeanSource.name))[0]
    evidence = FrameEvidence(data.features[80:])
    beliefs = localizer.beliefs(evidence)
    for mixture in beliefs.mixtures:
        own, masses = mixture.positions_xyz[mixture.measured], mixture.weights
        np.testing.assert_array_equal(own, data.targets[frames, :3].mean(axis=0)[None])
        # but for modes too improbable to keep
        assert masses[~mixture.measured].sum() / masses.sum() == pytest.approx(0.75, rel=1e-2)
    model = small_model()
    localizer = replace(model.localizer, sources=(model.localizer.sources[0], localizer.sources[1]))
    features = np.random.default_rng(0).normal(size=(5, model.backbone.n_features))
    evidence = FrameEvidence(features.astype(np.float32))
    beliefs = localizer.beliefs(evidence)
    with pytest.raises(OdometryError, match="no source uses them"):
        replace(model, localizer=localizer)
    rules = replace(model.rules, recognised=None, disturbed=None)
    model = replace(model, localizer=localizer, rules=rules, quality=None)
    save_model(model, tmp_path)
    back = load_model(tmp_path).localizer
    assert [type(source) for source in back.sources] == [HeadSource, MeanSource]
    for one, other in zip(localizer.sources, back.sources, strict=True):
        same_answers(one.answer(evidence), other.answer(evidence))
    np.testing.assert_array_equal(back.frames, frames)
    again = back.beliefs(evidence)
    for one, other in zip(localizer.marginals(beliefs), back.marginals(again), strict=True):
        np.testing.assert_array_equal(one, other)
    # where the class is not known, the model cannot be read, and the name says why
    monkeypatch.delitem(registry._KINDS, MeanSource.name)
    with pytest.raises(ModelFileError, match=f"got '{MeanSource.name}'"):
        load_model(tmp_path)


def test_other_processes_get_the_data_and_the_matches_so_far(data_of, monkeypatch):
    data, rng = replace(data_of(100), progress=lambda *_: None), np.random.default_rng(0)
    images = [LocalFeatures(np.zeros((9, 2)), rng.integers(0, 256, (9, 32), np.uint8), np.ones(3)) for _ in range(2)]
    data._keep([3, 4], images)
    matches = data.computed.matcher(images[0], images[1:])
    other = pickle.loads(pickle.dumps(data))
    monkeypatch.setattr("conformodal.features.local._best_pairs", None)  # matching again would fail
    one, two = other.local_features(np.array([3, 4]))
    np.testing.assert_array_equal(other.computed.matcher(one, [two]), matches)
    np.testing.assert_array_equal(other.features, data.features)
