"""The page about robots names the topics, types, parameters and limits that the code has."""

import re
import runpy
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from conformodal.ros.conventions import IMAGE, TOPICS, TRUTH, Conventions
from conformodal.ros.node import Parameters

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "robots.md").read_text(encoding="utf-8")


def rows(first):
    """Cells of the table whose first heading it is, without backticks."""
    table = re.search(rf"^\| {first} \|.*\n\|[- |]+\|\n((?:\|.*\n)+)", PAGE, re.MULTILINE)
    return [[cell.strip().strip("`") for cell in line.strip("|").split("|")] for line in table[1].splitlines()]


def test_topics_and_their_types_are_those_that_are_written():
    known = {**TOPICS, **TRUTH, **IMAGE}
    assert {name: kind for name, kind, _ in rows("topic")} == known
    assert f"`{Conventions().namespace}/`" in PAGE


def test_parameters_and_their_defaults_are_the_nodes():
    said = {name: default for name, default, _ in rows("parameter")}
    assert list(said) == [field.name for field in fields(Parameters)]
    for name, value in vars(Parameters()).items():
        assert said[name] == ("must be given" if name == "model" else str(value).lower())


def test_limits_are_those_of_the_conventions():
    how = Conventions()
    for words in (
        f"At most {how.most_boxes} boxes",
        f"no further than {how.range_m:g} m",
        f"the last {how.longest_path} poses",
        f"{how.lost_variance:,.0f} m²",
    ):
        assert words in PAGE.replace("\n", " "), words
    assert how.path_every == 10  # "every tenth"
    assert how.camera_frame in (ROOT / "docs" / "images" / "frames.svg").read_text(encoding="utf-8")


def test_the_picture_has_a_camera_that_looks_along_z_and_is_a_rotation():
    camera = runpy.run_path(str(ROOT / "docs" / "frames.py"))["CAMERA"]
    assert np.linalg.det(camera) == pytest.approx(1)
    right, down, forward = camera.T
    np.testing.assert_allclose(np.cross(right, down), forward, atol=1e-12)
    np.testing.assert_allclose(down, [0, 0, -1], atol=1e-12)  # it is level
