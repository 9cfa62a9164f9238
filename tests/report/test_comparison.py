from matplotlib.backends.backend_agg import FigureCanvasAgg

from conformodal.experiments.table1 import METHODS
from conformodal.report import error_chart


def test_no_method_is_left_out_of_the_chart():
    for names in (list(METHODS.values()), [f"method {k}" for k in range(20)]):
        svg = error_chart(["one", "two"], {name: [[0.1, 0.2], [0.3, 0.4]] for name in names}, "m")
        assert all(f">{name}<" in svg for name in names)


def test_the_legend_is_not_cut_off(monkeypatch):
    from conformodal.report import comparison

    drawn = []
    monkeypatch.setattr(comparison, "as_svg", lambda figure: drawn.append(figure) or "")
    error_chart(["one", "two"], {name: [[0.1, 0.2], [0.3, 0.4]] for name in METHODS.values()}, "m")
    (figure,) = drawn
    FigureCanvasAgg(figure).draw()
    legend = figure.legends[0].get_window_extent()
    assert 0 <= legend.x0 < legend.x1 <= figure.bbox.width


def test_the_methods_of_the_table_have_a_mark_each():
    from conformodal.report.comparison import _MARKS

    assert len(METHODS) <= len(_MARKS) == len(set(_MARKS))
