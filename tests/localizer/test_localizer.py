"""Sources of one belief, on stand-ins that say what they are told."""

from dataclasses import replace

import numpy as np
import pytest

from conformodal.conformal import QuantileBins
from conformodal.localizer import LocalizationError
from conformodal.localizer.evidence import FrameEvidence, PoseMeasurement
from conformodal.localizer.localizer import Localizer
from conformodal.localizer.sources import registry
from conformodal.localizer.sources.registry import SourceAnswer, register_source
from tests.localizer.conftest import Told

SIGN = np.array([1.0, 0, 0, 0])


Other = type("Other", (Told,), {"name": "other"})
Local = type("Local", (Told,), {"name": "local", "local": True})
Precise = type("Precise", (Told,), {"name": "precise", "least_sigma_m": 0.2})
# what the frames do not allow
Unable = type("Unable", (Told,), {"name": "unable", "fit": classmethod(lambda cls, data, frames: None)})


@pytest.fixture
def known(monkeypatch):
    """The stand-ins are known by name, for one test."""
    monkeypatch.setattr(registry, "_KINDS", dict(registry._KINDS))
    for kind in (Told, Other, Local, Unable):
        register_source(kind)


@pytest.fixture
def bins():
    return QuantileBins.from_edges([np.linspace(0, 10, 6)] * 3 + [np.linspace(-1, 1, 6)] * 4)


def told(kind=Told, frames=(0,), **says):
    return kind(np.array(frames), SourceAnswer(**says))


def estimate(x, probability=0.9):
    return PoseMeasurement(np.array([x, 5.0, 5.0]), np.array([0.0, 1, 0, 0]), 0.1, 0.1, 20, probability)


def softmax(bins, n, seed=0):
    rng = np.random.default_rng(seed)
    return [rng.dirichlet(np.ones(k), n) for k in bins.sizes]


def images(n):
    return FrameEvidence(np.zeros((n, 4), np.float32))


def test_there_is_a_source_and_all_have_different_names(bins):
    with pytest.raises(LocalizationError, match="at least one, got"):
        Localizer((), bins, SIGN)
    with pytest.raises(LocalizationError, match=r"different names.*'told', 'told'"):
        Localizer((told(), told()), bins, SIGN)
    assert Localizer((told(), told(Other)), bins, SIGN).sources[1].name == "other"


@pytest.mark.usefixtures("known")
def test_a_source_that_the_frames_do_not_allow_is_left_out(data_of):
    data, frames = data_of(30), np.arange(5, 25)
    found = Localizer.fit_each(data, [frames], ("unable", "other", "told"))[0]
    assert [source.name for source in found.sources] == ["other", "told"]  # in the order that was asked for
    for source in found.sources:
        np.testing.assert_array_equal(source.frames, frames)
    for one, other in zip(found.bins.edges_, data.bins_of(frames).edges_, strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(found.sign_reference, data.sign_reference)
    with pytest.raises(LocalizationError, match="at least one"):
        Localizer.fit_each(data, [frames], ("unable",))[0]


def test_missing_softmax_falls_back_to_training_prior(bins):
    """Bins of equal mass: each is as probable as any other."""
    source = told(measurements=[[], [estimate(3.0)]])
    found = Localizer((source,), bins, SIGN).beliefs(images(2))
    for p, k in zip(found.proba, bins.sizes, strict=True):
        np.testing.assert_array_equal(p, np.full((2, k), 1 / k))
    assert found.mixtures[1].measured.sum() == 1


def test_one_softmax_is_taken_as_it_is_and_of_several_the_mean(bins):
    a, b = softmax(bins, 3), softmax(bins, 3, seed=1)
    silent = told(Local, measurements=[[]] * 3)
    one = Localizer((silent, told(proba=a)), bins, SIGN).beliefs(images(3))
    for p, q in zip(one.proba, a, strict=True):
        np.testing.assert_array_equal(p, q)
    two = Localizer((told(Local, proba=a), told(Other, proba=b)), bins, SIGN).beliefs(images(3))
    for p, q, r in zip(two.proba, a, b, strict=True):
        np.testing.assert_allclose(p, (q + r) / 2, rtol=1e-15)


def test_only_local_features_recognise_places(bins):
    """Other sources are not asked where a place is recognised."""
    everywhere = told(measurements=[[estimate(2.0, 0.99)]], proba=softmax(bins, 1))
    local = told(Local, measurements=[[], [estimate(4.0, 0.95), estimate(5.0, 0.2)]])
    found = Localizer((everywhere, local), bins, SIGN).beliefs(images(2))
    assert [[one.position_xyz[0] for one in its] for its in found.estimates] == [[], [4.0, 5.0]]
    assert found.recognised.tolist() == [False, True]
    assert found.mixtures[1].positions_xyz[found.mixtures[1].measured, 0].tolist() == [4.0, 5.0]
    for p, q in zip(found.proba, everywhere.answers.proba, strict=True):
        np.testing.assert_array_equal(p, np.concatenate((q, np.full_like(q, 1 / q.size))))


@pytest.mark.parametrize(("sigma_m", "asked"), [(0.12, False), (0.14, True)])
def test_precise_source_is_asked_at_recognised_places(bins, sigma_m, asked):
    """If it may be two thirds as precise as the estimate there."""
    recognised = replace(estimate(4.0, 0.95), sigma_m=sigma_m)
    other = replace(estimate(4.1, 0.8), sigma_m=0.2)
    sources = told(Precise, measurements=[[other]]), told(Local, measurements=[[recognised]])
    [found] = Localizer(sources, bins, SIGN).beliefs(images(1)).mixtures
    product = 1 / (1 / sigma_m**2 + 1 / 0.2**2)
    expected = np.sqrt(product) if asked else sigma_m
    assert found.position_spreads[0] == pytest.approx(expected)
