"""The wheel is whole, installs in an environment of its own and runs; a release changes what it must, or nothing."""

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


def run(*command, **options):
    done = subprocess.run([str(c) for c in command], capture_output=True, text=True, check=False, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """Wheel and source distribution; the wheel is built from the source distribution."""
    return release.build(ROOT, tmp_path_factory.mktemp("dist"))


@pytest.fixture(scope="module")
def bare(built, tmp_path_factory):
    """Python of an environment with the wheel and what it cannot do without."""
    return release.environment(tmp_path_factory.mktemp("env") / "env", built[0], offline=True)


@pytest.mark.slow
def test_the_distributions_hold_what_they_need(built):
    wheel, source = built
    files = run("git", "ls-files", "src/conformodal", cwd=ROOT).splitlines()
    assert {name.removeprefix("src/") for name in files} <= set(zipfile.ZipFile(wheel).namelist())
    with tarfile.open(source) as archive:
        top = {name.split("/")[1] for name in archive.getnames() if "/" in name}
    assert {"src", "tests", "docs", "examples", "scripts", "README.md", "LICENSE", "CITATION.cff"} <= top


@pytest.mark.slow
def test_the_wheel_regresses_without_an_extra_and_names_the_one_that_the_command_line_needs(bare, tmp_path):
    release.check(bare, VERSION, tmp_path)
    with pytest.raises(release.ReleaseError, match="AssertionError"):
        release.check(bare, "99.0.0", tmp_path)


@pytest.fixture
def project(tmp_path):
    """A repository with what a release changes."""
    root = tmp_path / "project"
    root.mkdir()
    (root / "pyproject.toml").write_text('[project]\nname = "x"\nversion = "0.1.0"\nx = ["y==0.1.0"]\n')
    (root / "CITATION.cff").write_text("cff-version: 1.2.0\nversion: 0.1.0\ndate-released: 2020-01-01\nlicense: x\n")
    (root / "CHANGELOG.md").write_text("# Changelog\n\n## 0.2.0 (unreleased)\n\n- x\n\n## 0.1.0 (2020-01-01)\n")
    git = ("git", "-c", "user.name=x", "-c", "user.email=x@example.org", "-c", "commit.gpgsign=false")
    for command in (("init", "--quiet"), ("add", "."), ("commit", "--quiet", "-m", "x")):
        run(*git, *command, cwd=root)
    return root


@pytest.fixture
def no_build(monkeypatch):
    """Builds and checks that pass, without building."""

    def build(root, out):
        out.mkdir()
        for name in ("x.whl", "x.tar.gz"):
            (out / name).write_text("x")
        return out / "x.whl", out / "x.tar.gz"

    monkeypatch.setattr(release, "build", build)
    monkeypatch.setattr(release, "check_both", lambda *_, **__: None)


def contents(root):
    return {path.name: path.read_text() for path in root.iterdir() if path.is_file()}


def test_a_release_says_its_version_everywhere_and_leaves_the_tag_to_people(project, no_build):
    report = release.release(project, "0.2.0", offline=True, dry_run=False)
    files = contents(project)
    day = files["CHANGELOG.md"].split("## 0.2.0 (")[1][:10]
    assert files["pyproject.toml"] == '[project]\nname = "x"\nversion = "0.2.0"\nx = ["y==0.1.0"]\n'
    assert files["CITATION.cff"] == f"cff-version: 1.2.0\nversion: 0.2.0\ndate-released: {day}\nlicense: x\n"
    assert files["CHANGELOG.md"] == f"# Changelog\n\n## 0.2.0 ({day})\n\n- x\n\n## 0.1.0 (2020-01-01)\n"
    assert {path.name for path in (project / "dist").iterdir()} == {"x.whl", "x.tar.gz"}
    assert "git tag -a v0.2.0" in report
    assert run("git", "tag", cwd=project) == ""


def fail(*_, **__):
    raise release.ReleaseError("does not import")


@pytest.mark.parametrize(
    ("version", "spoil"),
    [
        ("0.2", lambda root, _: None),
        ("0.2.0.dev1", lambda root, _: None),
        ("0.3.0", lambda root, _: None),  # has no section
        ("0.0.9", lambda root, _: None),  # is older
        ("0.1.0rc1", lambda root, _: None),
        ("0.2.0", lambda root, _: (root / "new").write_text("x")),
        ("0.2.0", lambda root, _: run("git", "tag", "v0.2.0", cwd=root)),
        ("0.2.0", lambda _, monkeypatch: monkeypatch.setattr(release, "check_both", fail)),
    ],
)
def test_what_cannot_be_released_is_left_as_it_is(project, no_build, monkeypatch, version, spoil):
    spoil(project, monkeypatch)
    before = contents(project)
    with pytest.raises(release.ReleaseError):
        release.release(project, version, offline=True, dry_run=False)
    assert contents(project) == before
    assert not (project / "dist").exists()


def test_the_project_s_own_files_agree_on_the_version():
    for name, place in release.PLACES.items():
        assert place.findall((ROOT / name).read_text()) == [VERSION], name
    changes = (ROOT / "CHANGELOG.md").read_text()
    assert re.findall(r"(?m)^## (\S+) \((?:unreleased|\d{4}-\d\d-\d\d)\)$", changes)[0] == VERSION


def test_the_oldest_versions_are_the_lower_bounds():
    assert "numpy==1.26" in oldest.oldest((ROOT / "pyproject.toml").read_text())
    text = '[project]\nname = "x"\ndependencies = ["a-b>=1.2,<3"]\noptional-dependencies.c = ["x[d]", "e[f] == 4; y"]\n'
    assert oldest.oldest(text) == ["a-b==1.2", "e==4"]
    assert oldest.oldest(text.replace(">=1.2,<3", "<3,>=1.2")) == ["a-b==1.2", "e==4"]
    with pytest.raises(oldest.ConstraintError, match="'a-b'"):
        oldest.oldest(text.replace(">=1.2,<3", ""))
