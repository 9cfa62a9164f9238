"""Pictures of regions and coverage hold what the regions hold."""

import numpy as np
import pandas as pd
import pytest

from conformodal import Regions, draw_coverage, draw_regions
from conformodal.conformal import ConformodalError, PredictiveDensity, QuantileBins, SplitConformal, diagnose

figure = pytest.importorskip("matplotlib.figure")
save_picture = pytest.importorskip("conformodal.report.tables").save_picture
BINS = QuantileBins.from_edges([[0, 1, 2, 4], [0, 5]])
REGIONS = Regions(
    BINS, [np.array([[True, False, True], [False, True, False]]), np.ones((2, 1), bool)], np.zeros((2, 2), bool)
)


def boxes(ax):
    return sorted(path.get_extents().extents.tolist() for path in ax.collections[-1].get_paths())


def test_sets_stand_over_the_feature_and_the_truth_on_them():
    given = figure.Figure().subplots()
    y, density = np.array([[0.5, 1.0], [3.0, 1.0]]), PredictiveDensity(BINS, [np.full((2, 3), 1 / 3), np.ones((2, 1))])
    ax = draw_regions(REGIONS, y, [7.0, 5.0], density, ax=given)
    assert ax is given
    assert boxes(ax) == [[4.5, 1, 6, 2], [6, 0, 7.5, 1], [6, 2, 7.5, 4]]
    inside, outside = ax.lines
    assert (inside.get_xydata().tolist(), outside.get_xydata().tolist()) == ([[7.0, 0.5]], [[5.0, 3.0]])
    mesh = ax.collections[0].get_array()
    np.testing.assert_allclose(mesh, [[1 / 3, 1 / 3], [1 / 3, 1 / 3], [1 / 6, 1 / 6]])


def test_rows_and_unbounded_sets():
    whole = Regions(BINS, REGIONS.masks, np.ones((2, 2), bool))
    assert boxes(draw_regions(whole)) == [[-0.25, 0, 0.5, 4], [0.5, 0, 1.25, 4]]
    assert boxes(draw_regions(whole, target=1)) == [[-0.25, 0, 0.5, 5], [0.5, 0, 1.25, 5]]
    assert [c.get_hatch() for c in draw_regions(whole).collections] == ["///"]
    for options, match in (({"x": [1.0]}, "x and regions"), ({"y": [1.0]}, "y has shape")):
        with pytest.raises(ConformodalError, match=match):
            draw_regions(whole, **options)


def test_coverage_stands_beside_its_band():
    rng = np.random.default_rng(0)
    bins, y = QuantileBins(10).fit(rng.random(100)), rng.random(300)
    proba = np.full((150, 10), 0.1)
    found = diagnose(SplitConformal(bins, score="density").calibrate(proba, y[:150]), proba, y[150:])
    ax = draw_coverage(found)
    check = found.columns[0].coverage
    assert [line.get_xdata()[0] for line in ax.lines if len(line.get_xdata()) == 1][-1] == check.coverage
    assert any(
        np.isclose((bar.get_x(), bar.get_width()), (check.low, check.high - check.low)).all() for bar in ax.patches
    )
    units = SplitConformal(bins, score="density").calibrate(proba, y[:150], np.arange(150) // 5)
    ax = draw_coverage(diagnose(units, proba, y[150:]))  # no band holds for rows of units
    assert not ax.patches
    assert "band" not in ax.get_title() + ax.get_xlabel()


@pytest.mark.parametrize("name", ["$5_% to $6_%", "income: $10k to $20k"])
def test_dollars_in_names_are_drawn_as_they_are(name, tmp_path):
    rng = np.random.default_rng(0)
    proba, y = np.full((150, 10), 0.1), rng.random(300)
    bins = QuantileBins(10).fit(rng.random(100))
    bins.names = [name]
    split = SplitConformal(bins, score="density").calibrate(proba, y[:150])
    groups = np.where(np.arange(150) % 2, name, "other")
    ax = figure.Figure().subplots(2)
    draw_coverage(diagnose(split, proba, y[150:], groups=groups), ax=ax[0])
    draw_regions(split.predict(proba), x=pd.Series(np.arange(150), name=name), ax=ax[1])
    save_picture(ax[0].figure, tmp_path / "picture.svg")
    assert f"{name} (75) -->" in (tmp_path / "picture.svg").read_text()  # text is drawn as paths, with comments
    assert {text.get_parse_math() for text in (ax[0].title, ax[1].xaxis.label, ax[1].yaxis.label)} == {False}
