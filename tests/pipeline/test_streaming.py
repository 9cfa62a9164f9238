"""A stream through an estimator: frame by frame, in windows, and as a recording."""

import pickle
from contextlib import contextmanager
from itertools import islice

import cv2
import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from conformodal.features.extract import FeatureCache
from conformodal.features.settings import TrainingConfig
from conformodal.geometry import pose_targets
from conformodal.io import read_recording
from conformodal.io.streams.frames import Frame, RecordingStream, SourceError
from conformodal.localizer.filter import filter_posteriors
from conformodal.localizer.observations import choose_places
from conformodal.localizer.regions import EvidenceType
from conformodal.pipeline.config import ModelConfig
from conformodal.pipeline.estimator import VisualOdometry
from conformodal.pipeline.results import ResultsWriter, read_region_records, read_trajectories, records_hold
from conformodal.pipeline.store import load_model
from conformodal.pipeline.stream import StreamRunner
from conformodal.pipeline.train import train_model
from tests.helpers import run_ok


@pytest.fixture(scope="module")
def world(small_world):
    return read_recording(small_world.folder), load_model(small_world.model)


@pytest.fixture(scope="module")
def answered(world):
    """Some test frames, answered as a recording."""
    sequence, model = world
    frames = model.split.test[model.split.test < 150]
    return frames, VisualOdometry(model).process(sequence, frames)


@contextmanager
def running(world, folder, **options):
    with ResultsWriter(folder) as writer:
        runner = StreamRunner(VisualOdometry(world[1]), writer, **options)
        yield runner
        runner.finish()
        if runner.scores.truth is not None:
            writer.truth(runner.scores.truth)
    writer.publish({})


def stream(world, frames, folder, limit=None, **options):
    with running(world, folder, truth=world[0].truth, **options) as runner:
        for frame in islice(RecordingStream(world[0], frames), limit):
            runner.push(frame)
    return runner


def test_a_run_and_a_stream_write_equal_bytes(world, small_world, tmp_path):
    sequence, model = world
    options = ["--part", "test", "--limit", 60]
    run_ok("run", small_world.model, small_world.folder, "--out", tmp_path / "run", *options)
    runner = stream(world, model.split.test, tmp_path / "stream", limit=60)
    assert not runner.windowed
    names = ["regions.jsonl", "trajectory.tum", "truth.tum", "methods/online.tum", "methods/hindsight.tum"]
    for name in names:
        assert (tmp_path / "run" / name).read_bytes() == (tmp_path / "stream" / name).read_bytes(), name
    records = read_region_records(tmp_path / "stream" / "regions.jsonl")
    answered = model.split.test[: len(records)]
    assert 5 < len(records) == (model.split.test < model.split.test[0] + 60).sum()
    assert [r["frame"] for r in records] == [sequence.image_paths[i].name for i in answered]
    # what is on disk contains the poses that the regions contain
    sign, truth = model.sign_reference, runner.scores.truth
    np.testing.assert_array_equal(records_hold(records, truth, sign), runner.scores.statistics.held)
    # random frames calibrate, so the regions from several frames are for such streams
    assert "as many other frames drawn so" in runner.path_coverage["assumption"]
    paths = records_hold(records, truth, sign, "path_places")
    assert runner.path_coverage["online"]["coverage"] == paths.mean() > 0.7


@pytest.fixture(scope="module")
def by_stretch(small_world):
    """A model that stretches calibrate, and a test stretch."""
    sequence = read_recording(small_world.folder)
    config = ModelConfig(alpha=0.2, sources=("head",), training=TrainingConfig(epochs=15))
    model = train_model(sequence, config, cache=FeatureCache(small_world.cache))
    test = model.split.test
    return sequence, model, np.split(test, np.flatnonzero(np.diff(test) > 1) + 1)[0]


def test_path_regions_cover_new_stretches_at_any_rate(by_stretch):
    sequence, model, _ = by_stretch
    targets = pose_targets(sequence.truth, model.sign_reference)
    for step in (1, 3):  # the recording's own rate, and a third of it
        frames = model.split.test[::step]
        run = VisualOdometry(model).process(sequence, frames)
        assert run.path_regions.keys() == {"online", "hindsight"}
        for regions in run.path_regions.values():
            assert regions.contains(targets[frames], joint=True).mean() > 0.75
        # no reliable pose lies outside of its regions, beside another place, or where recognition is weak
        vouched = run.path_regions["online"][run.reliable]
        assert (vouched.n_places == 1).all()
        poses = pose_targets(run.trajectories["online"][run.reliable], model.sign_reference)
        for regions in (vouched, run.regions[run.reliable]):
            assert regions.contains(poses, joint=True).all()
        assert (run.known_p[run.reliable] > (model.novelty.matched or model.novelty.test).least_p).all()
    run = VisualOdometry(model).process(sequence, model.split.test[:25])
    for cut in (5, 12, 20):  # poses when their frame comes depend on no later frame
        observations = run.observations(np.arange(cut))
        path = choose_places(filter_posteriors(observations, model.prior), observations.timestamps_s, model.prior)
        online = run.trajectories["online"].positions_xyz[:cut]
        np.testing.assert_array_equal(path.positions_xyz, online, err_msg=f"{cut}")


def test_a_stream_looks_back(by_stretch):
    sequence, model, frames = by_stretch
    odometry = VisualOdometry(model)
    now = [odometry.step(sequence.image(i), sequence.timestamps_s[i]) for i in frames.tolist()]
    assert [len(one.revised) for one in now[:12]] == [*range(1, 12), 11]
    whole = VisualOdometry(model).process(sequence, frames[:11]).trajectories["hindsight"]
    np.testing.assert_allclose(now[10].revised.positions_xyz, whole.positions_xyz, atol=1e-9)
    assert pickle.loads(pickle.dumps(now[-1])).timestamp_s == now[-1].timestamp_s


def test_after_a_cut_to_another_scene_no_pose_is_reliable(world):
    sequence, model = world
    odometry, rng = VisualOdometry(model), np.random.default_rng(0)
    shape, last = sequence.image(0).shape, sequence.timestamps_s[31]
    for i in range(31):
        odometry.step(sequence.image(i), sequence.timestamps_s[i])
    alien = cv2.resize(rng.integers(0, 255, (9, 12, 3), dtype=np.uint8), shape[1::-1], interpolation=cv2.INTER_CUBIC)
    after = [odometry.step(np.roll(alien, k, axis=1), last + 0.1 * k) for k in range(20)]
    assert all(estimate.evidence is EvidenceType.UNKNOWN for estimate in after)
    assert not any(estimate.reliable for estimate in after)


def test_flow_is_from_the_usable_frame_before(world, monkeypatch):
    sequence, model = world
    frames, passed = np.arange(60, 90, 4), []
    localize = type(model).localize
    monkeypatch.setattr(type(model), "localize", lambda self, e: passed.extend(e.local_features) or localize(self, e))
    odometry = VisualOdometry(model)
    for frame in RecordingStream(sequence, frames):
        image = None if frame.index in (71, 79) else frame.image
        odometry.step(image, frame.timestamp_s) if frame.answer else odometry.track_only(image, frame.timestamp_s)
    moving = [i for i, features in zip(frames, passed, strict=True) if features.flow.any()]
    assert moving == [64, 68, 76, 84, 88]  # at 10 Hz, what was before a frame that cannot be read is too long ago


def test_windows_lose_no_frame_and_little_else(world, answered, tmp_path):
    frames, run = answered
    assert stream(world, frames, tmp_path, window=16, overlap=6).windowed
    written = read_trajectories(tmp_path)
    for name in ("smoothed", "hindsight", "online"):
        np.testing.assert_allclose(written[name].timestamps_s, run.timestamps_s, atol=1e-6)
    off = np.linalg.norm(written["hindsight"].positions_xyz - run.trajectories["hindsight"].positions_xyz, axis=1)
    assert np.mean(off < 1e-3) > 0.8
    online = run.trajectories["online"].positions_xyz  # does not depend on windows
    np.testing.assert_allclose(written["online"].positions_xyz, online, atol=1e-8)


def test_what_waits_does_not_grow(world, tmp_path):
    with running(world, tmp_path, window=12, overlap=4) as runner:
        for i, frame in enumerate(RecordingStream(world[0], np.arange(30))):
            runner.push(frame)
            assert len(runner._pending) < 12
            # regions are on disk at once, whatever happens next
            assert len((tmp_path / "regions.jsonl.part").read_text().splitlines()) == i + 1
    assert len(read_trajectories(tmp_path)["smoothed"]) == 30


def test_frames_without_an_image_are_counted(world, tmp_path):
    with running(world, tmp_path) as runner:
        for i, frame in enumerate(RecordingStream(world[0], np.arange(12))):
            bad = Frame(frame.name, frame.timestamp_s, None, "torn") if i in (0, 5) else frame
            estimate = runner.push(bad)
            assert (estimate.region is None) == (i in (0, 5))
        small = runner.push(Frame("small", 1e6, np.zeros((3, 3, 3), np.uint8)))
        assert "expected uint8" in small.problem
    assert (runner.n_answered, runner.n_problems) == (10, 3)
    assert list(runner.problems.values())[:2] == ["torn", "torn"]
    assert len(read_trajectories(tmp_path)["smoothed"]) == 10


def test_a_clock_set_back_ends_the_run_and_keeps_results(world, tmp_path):
    """A time that comes twice costs that frame alone."""
    frames = list(RecordingStream(world[0], np.arange(8)))
    with running(world, tmp_path) as runner:
        for frame in frames:
            runner.push(frame)
            assert runner.push(frame) is None
        assert (runner.n_answered, runner.n_problems) == (8, 8)
        for _ in range(9):
            assert runner.push(frames[3]) is None
        with pytest.raises(SourceError, match=r"frame-000003.* follows frame-000007"):
            runner.push(frames[3])
    for trajectory in read_trajectories(tmp_path).values():
        assert len(trajectory) == 8


def test_recordings_are_answered_apart(world, tmp_path):
    frames = list(RecordingStream(world[0], np.arange(20)))
    with running(world, tmp_path) as runner:
        for i, frame in enumerate(frames):
            runner.push(Frame(frame.name, frame.timestamp_s, frame.image, recording=int(i >= 10)))
    records = read_region_records(tmp_path / "regions.jsonl")
    assert [i for i, r in enumerate(records) if r["motion"] == "first"] == [0, 10]
    times = read_trajectories(tmp_path)["smoothed"].timestamps_s
    np.testing.assert_allclose(times, [f.timestamp_s for f in frames], atol=1e-6)


def test_a_step_multiplies_matrices_in_one_thread(world, monkeypatch):
    sequence, model = world
    odometry, threads = VisualOdometry(model), []
    answer = VisualOdometry._answer

    def recorded(self, *args):
        threads.extend(one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas")
        return answer(self, *args)

    monkeypatch.setattr(VisualOdometry, "_answer", recorded)
    with threadpool_limits(2, user_api="blas"):
        odometry.step(sequence.image(0), 0.0)
        assert {one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"} == {2}
    assert set(threads) == {1}
