from conformodal.experiments.table1 import METHODS
from conformodal.report import error_chart


def test_no_method_is_left_out_of_the_chart():
    for names in (list(METHODS.values()), [f"method {k}" for k in range(20)]):
        svg = error_chart(["one", "two"], {name: [[0.1, 0.2], [0.3, 0.4]] for name in names}, "m")
        assert all(f">{name}<" in svg for name in names)


def test_the_methods_of_the_table_have_a_mark_each():
    from conformodal.report.comparison import _MARKS

    assert len(METHODS) <= len(_MARKS) == len(set(_MARKS))
