import numpy as np
import pytest
from PIL import Image
from safetensors.numpy import save as save_tensors

from conformodal.features.backbone import Backbone, coarse_features, feature_views
from conformodal.features.extract import FeatureCache, extract_features
from conformodal.features.head import fit_projection
from conformodal.io import ImageError, PixelNoise, thumbnail


@pytest.fixture
def images(tmp_path):
    rng = np.random.default_rng(0)
    paths = [tmp_path / f"{i}.png" for i in range(5)]
    for path in paths:
        Image.fromarray(rng.integers(0, 255, (128, 192, 3), dtype=np.uint8)).save(path)
    return paths


def test_noisy_images_have_their_own_cache_entries(backbone, images, tmp_path):
    cache = FeatureCache(tmp_path / "cache")
    clean = extract_features(images, backbone, cache)
    noise = PixelNoise(0.1)
    noisy = extract_features(images, backbone, cache, noise=noise)
    assert np.abs(noisy - clean).max() > 0.1
    np.testing.assert_array_equal(extract_features(images, backbone, cache, noise=noise), noisy)
    np.testing.assert_array_equal(extract_features(images, backbone, cache, noise=PixelNoise(0.0)), clean)
    np.testing.assert_array_equal(extract_features(images, backbone, cache), clean)
    shown = noise.apply(np.asarray(Image.open(images[0])), images[0].name)
    np.testing.assert_array_equal(noisy[:1], backbone.features_of(shown))


def test_features_are_the_networks_map_and_the_thumbnail(backbone):
    image = np.random.default_rng(0).integers(0, 255, (64, 96, 3), dtype=np.uint8)
    features = backbone.features_of(image)
    views, picture = feature_views(features.shape[1]), thumbnail(image)
    np.testing.assert_allclose(features[:, views.network], backbone.maps(image[None]), rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(features[0, views.thumbnail], picture * np.sqrt(len(picture)), rtol=1e-3, atol=1e-3)
    assert features[:, views.both].shape == features.shape


def test_cached_features_are_the_same_and_need_no_network(backbone, images, tmp_path, monkeypatch):
    cache = FeatureCache(tmp_path / "cache")
    seen = []
    first = extract_features(images, backbone, cache, lambda done, total: seen.append((done, total)))
    assert first.shape == (5, 480 + 768)  # the network's map and the thumbnail
    assert seen[-1] == (5, 5)
    np.testing.assert_array_equal(extract_features(images, backbone, FeatureCache(None)), first)
    monkeypatch.setattr(Backbone, "maps", lambda *_: pytest.fail("the network was run again"))
    moved = tmp_path / "elsewhere.png"
    images[2].rename(moved)
    np.testing.assert_array_equal(extract_features([moved], backbone, cache), first[2:3])


# what is in the file instead, from its content and the features
DAMAGE = {
    "empty": lambda content, _: b"",
    "cut in half": lambda content, _: content[: len(content) // 2],
    "bit in the middle": lambda content, _: content[:2000] + bytes([content[2000] ^ 4]) + content[2001:],
    "other array": lambda _, vector: save_tensors({"features": np.append(vector, 0).astype(np.float16)}),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_features_are_made_again(backbone, images, tmp_path, damage):
    cache = FeatureCache(tmp_path / "cache")
    expected, key = extract_features(images, backbone, cache), cache.key(backbone, images[1])
    path = cache.folder / "features" / key[:2] / f"{key}.safetensors"
    path.write_bytes(DAMAGE[damage](path.read_bytes(), expected[1]))
    assert cache.load(key) is None
    assert not path.exists()
    np.testing.assert_array_equal(extract_features(images, backbone, cache), expected)
    np.testing.assert_array_equal(cache.load(key), expected[1].astype(np.float16))


def test_unreadable_images_are_named(backbone, images, tmp_path):
    images[3].write_bytes(images[3].read_bytes()[:200])
    with pytest.raises(ImageError, match=r"3\.png"):
        extract_features(images, backbone, FeatureCache(None))
    with pytest.raises(ImageError, match="absent"):
        extract_features([tmp_path / "absent.png"], backbone, FeatureCache(None))


def test_projected_features_are_centred_and_uncorrelated():
    """Their mean variance is one."""
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


@pytest.mark.parametrize("grid", [(3, 4), (12, 4), (1, 1), (5, 7)])
def test_coarse_features_follow_the_grid_of_their_network(grid):
    rows, columns = grid
    features = np.random.default_rng(2).normal(size=(5, 4 * rows * columns + 768)).astype(np.float32)
    maps = features[:, : 4 * rows * columns].reshape(5, 4, rows, columns)
    expected = [
        maps[:, :, i : i + 2, j : j + 2].mean(axis=(2, 3)) for i in range(0, rows, 2) for j in range(0, columns, 2)
    ]
    coarse = coarse_features(features, grid)
    np.testing.assert_allclose(coarse, np.stack(expected, axis=2).reshape(5, -1), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(("n", "n_features"), [(30, 80), (80, 30)])
def test_projections_are_those_of_a_singular_value_decomposition(n, n_features):
    rng = np.random.default_rng(5)
    x = rng.standard_normal((n, n_features)).astype(np.float32) * np.linspace(1, 3, n_features, dtype=np.float32)
    x[1] = x[0]  # a sample that repeats
    standard = (x - x.mean(axis=0)) / (x.std(axis=0) + 1e-3)
    _, lengths, directions = np.linalg.svd(standard.astype(np.float64) - standard.mean(axis=0), full_matrices=False)
    k = min(n - 2, n_features)  # as many as there are directions
    expected = np.abs((x - x.mean(axis=0)) / (x.std(axis=0) + 1e-3) @ directions[:k].T)
    gain = np.sqrt((lengths[:k] ** 2).mean() / (n - 1))
    np.testing.assert_allclose(np.abs(fit_projection(x, k).apply(x)), expected / gain, atol=2e-3)
    every = fit_projection(x, n)
    assert np.isfinite(every.components).all()
    assert np.abs(every.apply(x)).max() < 100
