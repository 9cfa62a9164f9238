import numpy as np
import pytest
import torch
from PIL import Image

from conformodal.networks import TorchBackbone, fine_tune, pick_device
from conformodal.networks.augmentation import augment
from conformodal.networks.shares import BatchShare
from conformodal.vision import BackboneConfig, FeatureCache, FineTuning, VisionError

SMALL = BackboneConfig(width=64, height=48, grid=(2, 2), block=2)
TUNING = FineTuning(blocks=1, epochs=4, batch_size=8, learning_rate=3e-3)


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """A bright patch on the left or on the right, and which."""
    folder, rng = tmp_path_factory.mktemp("pictures"), np.random.default_rng(0)
    paths, labels = [], []
    for i in range(24):
        image = rng.integers(0, 60, (48, 64, 3), dtype=np.uint8)
        image[16:32, (4 if i % 2 else 44) : (20 if i % 2 else 60)] += 180
        paths.append(folder / f"{i}.png")
        Image.fromarray(image).save(paths[-1])
        labels.append([i % 2, 1 - i % 2])
    return paths, np.array(labels, dtype=np.float32)


def same_weights(a, b):
    return [k for k, v in a.weights().items() if np.array_equal(v, b.weights()[k])]


def test_the_last_blocks_learn_and_the_others_stay(pictures):
    backbone = TorchBackbone(SMALL)
    before = backbone.weights()
    tuned = fine_tune(backbone, *pictures, [2], TUNING, FeatureCache(None))
    assert backbone.tuned is None
    assert all(np.array_equal(v, backbone.weights()[k]) for k, v in before.items())
    assert tuned.fingerprint != backbone.fingerprint
    assert not any(p.requires_grad for p in tuned.parameters())
    stayed, changed = set(same_weights(backbone, tuned)), set(before) - set(same_weights(backbone, tuned))
    last = [k for k in before if k.startswith("5.")]  # stem, its norm, activation, blocks 0 to 2, pooling
    assert changed <= set(last)
    assert any("weight" in k for k in changed)
    assert all("running" not in k for k in changed)  # batch statistics stay
    assert stayed | changed == set(before)
    everything = fine_tune(backbone, *pictures, [2], FineTuning(None, 1, 8), FeatureCache(None))
    assert any(k.startswith("0.") for k in set(before) - set(same_weights(backbone, everything)))


def test_tuning_is_seeded_and_kept(pictures, tmp_path, monkeypatch):
    backbone, cache = TorchBackbone(SMALL), FeatureCache(tmp_path)
    seen = []
    first = fine_tune(backbone, *pictures, [2], TUNING, cache, lambda *a: seen.append(a))
    assert seen == [(k, 4) for k in range(1, 5)]
    again = fine_tune(backbone, *pictures, [2], TUNING, FeatureCache(None))
    assert again.fingerprint == first.fingerprint
    monkeypatch.setattr("conformodal.networks.tuning_loop.run_tuning", lambda *_: pytest.fail("tuned again"))
    assert fine_tune(backbone, *pictures, [2], TUNING, cache).fingerprint == first.fingerprint
    monkeypatch.undo()
    (kept,) = (tmp_path / "backbones").iterdir()
    kept.write_bytes(kept.read_bytes()[:100])
    assert fine_tune(backbone, *pictures, [2], TUNING, cache).fingerprint == first.fingerprint


def test_a_stopped_tuning_goes_on(pictures, tmp_path):
    def stop(done, _):
        if done == 2:
            raise KeyboardInterrupt

    backbone, cache, seen = TorchBackbone(SMALL), FeatureCache(tmp_path), []
    with pytest.raises(KeyboardInterrupt):
        fine_tune(backbone, *pictures, [2], TUNING, cache, stop)
    fine_tune(backbone, *pictures, [2], TUNING, cache, lambda done, _: seen.append(done))
    assert seen[0] in (2, 3)
    assert seen[-1] == 4
    assert not list((tmp_path / "training").iterdir())


@pytest.mark.slow
@pytest.mark.parametrize("batch_size", [7, 23])  # the last batch has three images, and one
def test_two_processes_give_what_one_gives(pictures, batch_size):
    backbone, config = TorchBackbone(SMALL), FineTuning(blocks=1, epochs=3, batch_size=batch_size, learning_rate=1e-3)
    before = backbone.weights()
    kept = {name: value.copy() for name, value in before.items()}
    one, two = (fine_tune(backbone, *pictures, [2], config, FeatureCache(None), processes=n).weights() for n in (1, 2))
    assert all(np.array_equal(before[name], kept[name]) for name in kept)  # the memory of the network stays its own
    moved = max(np.abs(one[k] - before[k]).max() for k in one if one[k].dtype == np.float32)
    off = max(np.abs(one[k] - two[k]).max() for k in one if one[k].dtype == np.float32)
    assert moved > 1e-3
    assert off < 1e-4


def test_a_row_is_augmented_alike_in_a_share_of_the_batch(monkeypatch):
    images = torch.randint(0, 256, (5, 20, 30, 3), dtype=torch.uint8)

    def changed(rank, n_processes):
        monkeypatch.setattr("conformodal.networks.shares.place", lambda: (rank, n_processes))
        share = BatchShare(5)
        torch.manual_seed(0)
        return augment(images[share.rows], share)

    whole, first, second = changed(0, 1), changed(0, 2), changed(1, 2)
    assert torch.equal(first, whole[::2])
    assert torch.equal(second, whole[1::2])
    losses = torch.arange(5.0)
    monkeypatch.setattr("conformodal.networks.shares.place", lambda: (0, 2))
    halves = [BatchShare(5).mean(losses[::2])]
    monkeypatch.setattr("conformodal.networks.shares.place", lambda: (1, 2))
    halves.append(BatchShare(5).mean(losses[1::2]))
    assert float(sum(halves)) / 2 == pytest.approx(float(losses.mean()))
    assert float(BatchShare(1).mean(losses[:1])) == 0  # a row that another process works on


def test_augmented_images_stay_images_and_differ():
    torch.manual_seed(0)
    images = torch.randint(0, 256, (6, 20, 30, 3), dtype=torch.uint8)
    changed = augment(images)
    assert changed.shape == images.shape
    assert changed.dtype == torch.float32
    assert 0 <= float(changed.min()) <= float(changed.max()) <= 255
    off = (changed - images).abs().mean(dim=(1, 2, 3))
    assert len(set(off.tolist())) == 6
    # nothing is moved: what was bright is still where it was
    for a, b in zip(images, changed, strict=True):
        assert np.corrcoef(a.numpy().ravel(), b.numpy().ravel())[0, 1] > 0.6


def test_half_of_the_images_are_covered_in_part(monkeypatch):
    monkeypatch.setattr("conformodal.networks.augmentation._NOISE", 0.0)
    torch.manual_seed(0)
    changed = augment(torch.full((1000, 20, 30, 3), 128.0))
    covered = changed.std(dim=(1, 2)).amax(dim=1) > 1e-3
    # one in two, but for rectangles that hold no pixel, about one in six; four deviations of a binomial are 0.063
    assert 0.35 < float(covered.float().mean()) < 0.563


@pytest.mark.parametrize("settings", [{"blocks": 0}, {"epochs": 0}, {"learning_rate": 0.0}])
def test_settings_out_of_range_are_refused(settings):
    with pytest.raises(VisionError, match=next(iter(settings))):
        FineTuning(**settings)


def test_labels_must_fit(pictures):
    with pytest.raises(VisionError, match="two images or more"):
        fine_tune(TorchBackbone(SMALL), pictures[0], pictures[1][:5], [2], TUNING, FeatureCache(None))


def test_weights_of_another_network_are_refused():
    with pytest.raises(VisionError, match="do not fit"):
        TorchBackbone(SMALL).take_weights({"0.weight": np.zeros(3, np.float32)})


def test_devices_by_name():
    assert pick_device("cpu").type == "cpu"
    assert pick_device("auto").type == ("cuda" if torch.cuda.is_available() else "cpu")
    with pytest.raises(VisionError, match="tpu"):
        pick_device("tpu")
    if not torch.cuda.is_available():
        with pytest.raises(VisionError, match="no graphics card"):
            pick_device("cuda")
