import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from experiments.drawing import SoftmaxOfTarget, Steps, binning_figure, overview_figure, softmax_figure

EDGES = np.array([0.0, 1.0, 1.5, 2.0, 4.0])
PROBA = np.array([0.5, 0.05, 0.05, 0.4])
SET = SoftmaxOfTarget("x", EDGES, PROBA, 0.1, np.array([[0.0, 1.0], [2.0, 4.0]]), 2.5)


def drawn(figure):
    FigureCanvasAgg(figure).draw()
    return figure


def test_every_label_is_hot_in_the_bin_that_holds_the_value():
    values = np.array([0.2, 1.2, 1.7, 3.0, 4.0])  # the last edge belongs to the last bin
    figure = drawn(binning_figure(np.arange(5.0), values, EDGES, "x"))
    (image,) = figure.axes[1].get_images()
    np.testing.assert_array_equal(np.asarray(image.get_array()).argmax(axis=0), [0, 1, 2, 3, 3])
    assert np.asarray(image.get_array()).sum() == len(values)
    assert figure.axes[1].get_xlabel() == "training frame"


@pytest.mark.parametrize("n", [1, 2])
def test_bars_at_or_above_the_threshold_are_the_set(n):
    one = SoftmaxOfTarget("x", EDGES, PROBA, 0.1 if n == 2 else 0.45, SET.intervals[:n], 2.5)
    figure = drawn(softmax_figure(one))
    bars = figure.axes[0].patches[:4]
    inside = [bar.get_facecolor() == bars[0].get_facecolor() for bar in bars]
    assert inside == [True, False, False, n == 2]
    assert [bar.get_width() for bar in bars] == pytest.approx(np.diff(EDGES))
    assert figure.axes[0].get_title() == ("1 interval" if n == 1 else "2 intervals")


def test_overview_has_one_panel_per_step():
    """Also where a set is empty or the whole line."""
    empty = SoftmaxOfTarget("y", EDGES, PROBA, 0.9, np.empty((0, 2)), 2.5)
    whole = SoftmaxOfTarget("z", EDGES, PROBA, -np.inf, np.array([[-np.inf, np.inf]]), 2.5)
    rng = np.random.default_rng(0)
    corners, path = rng.random((9, 2)) * 30, rng.random((6, 3)) * 4
    image = np.zeros((48, 64, 3), np.uint8)
    for softmaxes in ((SET, SET, SET), (SET, empty, whole)):
        for shown in range(3):
            steps = Steps(image, softmaxes, shown, (corners, corners + 1), path, path + 0.1, 3)
            figure = drawn(overview_figure(steps))
            assert [axis.get_title()[0] for axis in figure.axes] == list("123456")
