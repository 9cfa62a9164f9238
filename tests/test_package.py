"""The wheel is whole, installs in an environment of its own and runs; the files of a release agree on its version."""

import importlib.util
import re
import subprocess
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def script(name):
    """A script as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "scripts" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


release, oldest = script("release"), script("oldest")
VERSION = release.PLACES["pyproject.toml"].findall((ROOT / "pyproject.toml").read_text())[0]


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """Wheel and source distribution; the wheel is built from the source distribution."""
    return release.build(ROOT, tmp_path_factory.mktemp("dist"))


@pytest.mark.slow
def test_the_distributions_hold_what_they_need(built):
    wheel, source = built
    files = subprocess.run(["git", "ls-files", "src/conformodal"], cwd=ROOT, capture_output=True, text=True, check=True)
    assert {name.removeprefix("src/") for name in files.stdout.splitlines()} <= set(zipfile.ZipFile(wheel).namelist())
    with tarfile.open(source) as archive:
        top = {name.split("/")[1] for name in archive.getnames() if "/" in name}
    assert {"src", "tests", "docs", "examples", "scripts", "README.md", "LICENSE", "CITATION.cff"} <= top


@pytest.mark.slow
def test_the_wheel_needs_no_extra_for_tables(built, tmp_path):
    """Its command line names the extra that it needs."""
    bare = release.environment(tmp_path / "env", built[0], offline=True)
    release.check(bare, VERSION, tmp_path)
    with pytest.raises(release.ReleaseError, match="AssertionError"):
        release.check(bare, "99.0.0", tmp_path)


CHANGES = "# Changelog\n\nDates.\n\n## 0.2.0 (2026-01-02)\n\n- x\n\n## 0.1.0 (2020-01-01)\n"


@pytest.mark.parametrize(
    ("file", "text"),
    [
        (None, ""),
        ("pyproject.toml", 'version = "0.1.0"\n'),
        ("CITATION.cff", "version: 0.1.0\n"),
        ("CHANGELOG.md", CHANGES.replace("2026-01-02", "unreleased")),
    ],
)
def test_a_version_that_a_file_does_not_say_is_not_released(tmp_path, file, text):
    right = {"pyproject.toml": 'version = "0.2.0"\n', "CITATION.cff": "version: 0.2.0\n", "CHANGELOG.md": CHANGES}
    for name, content in (right | {file: text} if file else right).items():
        (tmp_path / name).write_text(content)
    # without a repository, the tree's state cannot be told: what comes after the files
    with pytest.raises(release.ReleaseError, match="not a git repository" if file is None else file):
        release.check_places(tmp_path, "0.2.0")


def test_the_project_s_own_files_agree_on_the_version():
    assert release.PLACES["CITATION.cff"].findall((ROOT / "CITATION.cff").read_text()) == [VERSION]
    changes = (ROOT / "CHANGELOG.md").read_text()
    assert re.findall(r"(?m)^## (\S+) \((?:unreleased|\d{4}-\d\d-\d\d)\)$", changes)[0] == VERSION


def test_the_oldest_versions_are_the_lower_bounds():
    assert "numpy==1.26" in oldest.oldest((ROOT / "pyproject.toml").read_text())
    text = '[project]\nname = "x"\ndependencies = ["a-b>=1.2,<3"]\noptional-dependencies.c = ["x[d]", "e[f] == 4; y"]\n'
    assert oldest.oldest(text) == ["a-b==1.2", "e==4"]
    with pytest.raises(oldest.ConstraintError, match="'a-b'"):
        oldest.oldest(text.replace(">=1.2,<3", ""))
