from dataclasses import replace

import numpy as np
import pytest

from conformodal.io import DatasetError, make_split
from conformodal.io.recording import join_recordings
from conformodal.io.streams import RecordingStream, SourceError, open_stream
from conformodal.io.streams.frames import join_streams
from tests.io.streams.test_streams import video


def part(sequence, first, last, **changes):
    rows = slice(first, last)
    own = replace(
        sequence,
        image_paths=sequence.image_paths[rows],
        timestamps_s=sequence.timestamps_s[rows],
        recording=sequence.recording[rows] + 4,
        poses=sequence.truth[rows],
    )
    return replace(own, **changes)


def test_joined_recordings_are_renumbered_in_order(sequence):
    """They keep their poses."""
    late, early = part(sequence, 20, 40), part(sequence, 0, 20)
    assert join_recordings([late]) is late
    whole = join_recordings([late, early, part(sequence, 50, 60)])
    np.testing.assert_array_equal(whole.recording, np.repeat([0, 1, 2], [20, 20, 10]))
    assert whole.timestamps_s[20] == whole.timestamps_s[19] + 10  # it was earlier, so it begins later
    np.testing.assert_allclose(np.diff(whole.timestamps_s[20:40]), np.diff(early.timestamps_s))
    np.testing.assert_array_equal(whole.require_truth().positions_xyz[20:40], early.truth.positions_xyz)
    np.testing.assert_array_equal(whole.require_truth().timestamps_s, whole.timestamps_s)
    assert whole.image_paths[20] == early.image_paths[0]


def test_a_data_set_that_tests_is_held_out_whole(sequence):
    whole = join_recordings(
        [part(sequence, 0, 30), part(sequence, 30, 60), part(sequence, 60, 70)], [False, False, True]
    )
    split = make_split(whole.recording, "given", given_test=whole.given_test)
    np.testing.assert_array_equal(split.test, np.arange(60, 70))
    assert join_recordings([part(sequence, 0, 3), part(sequence, 3, 9)]).given_test is None


def test_images_of_another_camera_are_brought_to_the_first(sequence, tmp_path, monkeypatch):
    monkeypatch.setenv("CONFORMODAL_CACHE", str(tmp_path))
    other = replace(sequence.camera, fx=1.2 * sequence.camera.fx, fy=1.2 * sequence.camera.fy)
    whole = join_recordings([part(sequence, 0, 2), part(sequence, 2, 4, camera=other)])
    assert whole.camera == sequence.camera
    assert whole.image(3).shape == sequence.image(3).shape
    assert [what for what, _ in whole.notes] == ["images of another camera are brought to one"]
    brought, cached = whole.image(3), whole.image_paths[3]
    cached.write_bytes(cached.read_bytes()[:-20])  # made again
    again = join_recordings([part(sequence, 0, 2), part(sequence, 2, 4, camera=other)])
    np.testing.assert_array_equal(again.image(3), brought)


def test_a_frame_in_two_data_sets_and_two_units_are_refused(sequence):
    with pytest.raises(DatasetError, match="is in two of the data sets"):
        join_recordings([part(sequence, 0, 5), part(sequence, 4, 8)])
    with pytest.raises(DatasetError, match="lengths in units"):
        join_recordings([part(sequence, 0, 5), part(sequence, 5, 8, unit="units")])
    assert len(join_recordings([part(sequence, 0, 5), part(sequence, 5, 8, unit="units", poses=None)])) == 8


def test_data_set_streams_are_joined_in_order(sequence, tmp_path):
    """Other sources are refused."""
    one, other = (RecordingStream(part(sequence, *rows)) for rows in ((10, 14), (0, 3)))
    frames = list(join_streams([one, other]))
    assert [frame.recording for frame in frames] == [0, 0, 0, 0, 1, 1, 1]
    assert (np.diff([frame.timestamp_s for frame in frames]) > 0).all()
    with pytest.raises(SourceError, match=r"v\.avi: is one of several sources"):
        join_streams([one, open_stream(video(tmp_path / "v.avi", n=3))])
