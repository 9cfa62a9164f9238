import re
from pathlib import Path

import numpy as np

from conformodal.datasets import Sequence
from conformodal.poses import PinholeCamera, Trajectory
from conformodal.quality.advice import quality_record
from conformodal.quality.examining import RecordingQuality
from conformodal.quality.view_coverage import ViewScale, pose_coverage
from conformodal.report.quality import quality_plan, write_quality_page

N = 120
EVERY = np.arange(N)
ZERO = np.zeros(N, dtype=np.int64)


def judged(known=None):
    """A straight way, of which the frames 50 to 69 are not known."""
    positions = np.column_stack((0.04 * EVERY, ZERO, ZERO))
    poses = Trajectory(EVERY / 10, positions, np.tile([1.0, 0, 0, 0], (N, 1)))
    known = (EVERY < 50) | (EVERY >= 70) if known is None else known
    scale = ViewScale(2.0, 1.5)
    coverage = pose_coverage(poses, ZERO, poses[known], scale)
    sequence = Sequence(
        "<b>",
        tuple(Path(f"{i}.png") for i in EVERY),
        poses.timestamps_s,
        ZERO,
        PinholeCamera(9, 9, 8, 8, 16, 16),
        poses,
    )
    return RecordingQuality(sequence, EVERY, poses, np.flatnonzero(known), scale, coverage, None, [])


def test_the_plan_tells_kinds_apart_by_marks_and_words():
    plan = quality_plan(judged())
    for said in ("well covered (114 frames)", "sparsely covered (6)", "57-62", "x (m)", "y (m)"):
        assert said in plan
    assert "ambiguous" not in plan
    known = "".join(re.findall(r"<text[^>]*>([^<]*)", quality_plan(judged(EVERY >= 0))))
    assert "sparsely" not in known
    assert "well covered (120 frames)" in known


def test_the_page_says_what_to_record_next(tmp_path):
    found = judged()
    made = {"provenance": {}, "configuration": {}, "quality": quality_record(found)}
    write_quality_page(tmp_path, found, made, ["2 x image cannot be read: a.png"])
    page = (tmp_path / "report.html").read_text()
    assert "<title>Is &lt;b&gt; good enough?</title>" in page
    assert "Train on frames 57 to 62 (around x=2.4, y=0.0) or" in page
    assert "2 x image cannot be read: a.png" in page
    assert "57 (57.png)" in page
    assert 'aria-label="Plan' in page
    assert (tmp_path / "figures" / "plan.svg").read_text().startswith("<svg")


def test_a_page_of_a_recording_that_lacks_nothing_says_so(tmp_path):
    found = judged(EVERY >= 0)
    made = {"provenance": {}, "configuration": {}, "quality": quality_record(found)}
    write_quality_page(tmp_path, found, made, [])
    assert "Nothing is missing, as far as this can tell." in (tmp_path / "report.html").read_text()
