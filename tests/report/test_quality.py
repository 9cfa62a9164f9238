import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from conformodal.geometry import PinholeCamera, Trajectory
from conformodal.io import Recording
from conformodal.quality.advice import quality_record
from conformodal.quality.examining import RecordingQuality
from conformodal.quality.view_coverage import ViewScale, pose_coverage
from conformodal.report.figures import quality_plan, write_quality_page

N = 120
EVERY = np.arange(N)
ZERO = np.zeros(N, dtype=np.int64)


def examined(known=None, recording=ZERO):
    """A straight way, of which the frames 50 to 69 are not known."""
    positions = np.column_stack((0.04 * EVERY, ZERO, ZERO))
    poses = Trajectory(EVERY / 10, positions, np.tile([1.0, 0, 0, 0], (N, 1)))
    known = (EVERY < 50) | (EVERY >= 70) if known is None else known
    scale = ViewScale(2.0, 1.5)
    coverage = pose_coverage(poses, recording, poses[known], scale)
    paths, camera = tuple(Path(f"{i}.png") for i in EVERY), PinholeCamera(9, 9, 8, 8, 16, 16)
    sequence = Recording("<b>", paths, poses.timestamps_s, recording, camera, poses)
    return RecordingQuality(sequence, EVERY, poses, np.flatnonzero(known), scale, coverage)


def test_the_plan_labels_view_coverage():
    plan = quality_plan(examined())
    for label in ("well covered (114)", "sparsely covered (6)", "57-62"):
        assert label in plan
    assert "sparsely" not in "".join(re.findall(r"<text[^>]*>([^<]*)", quality_plan(examined(EVERY >= 0))))
    assert "recording 2, well covered (60)" in quality_plan(examined(EVERY >= 0, EVERY // 60))


def test_the_plan_has_the_unit_of_the_recording():
    quality = examined()
    in_units = replace(quality, sequence=replace(quality.sequence, unit="units"))
    assert ("x (m)" in quality_plan(quality), "x (units)" in quality_plan(in_units)) == (True, True)


@pytest.mark.parametrize("missing", [True, False])
def test_the_page_names_what_to_record_next(tmp_path, missing):
    quality = examined(None if missing else EVERY >= 0)
    made = {"provenance": {}, "configuration": {}, "quality": quality_record(quality)}
    write_quality_page(tmp_path, quality, made, ["2 x image cannot be read: a.png"])
    page = (tmp_path / "report.html").read_text()
    assert "<title>Is &lt;b&gt; good enough?</title>" in page
    assert ("frames 57 to 62 (around x=2.4, y=0.0)" in page) == missing
    assert "2 x image cannot be read: a.png" in page
    assert (tmp_path / "figures" / "plan.svg").read_text().startswith("<svg")
