"""The wheel is whole: what is built from the source distribution installs in an environment of its own and runs."""

import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def run(*command, **options):
    done = subprocess.run([str(c) for c in command], capture_output=True, text=True, check=False, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The folder with source distribution and wheel; the wheel is built from the source distribution."""
    out = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", out, ROOT)
    return out


@pytest.fixture(scope="module")
def python(built, tmp_path_factory):
    """Python of an empty environment with the wheel; other packages are this one's."""
    folder = tmp_path_factory.mktemp("env")
    run(sys.executable, "-m", "venv", folder)
    (wheel,) = built.glob("*.whl")
    run(folder / "bin" / "pip", "install", "--quiet", "--no-deps", "--no-index", wheel)
    (site,) = folder.glob("lib/python*/site-packages")
    (site / "others.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return folder / "bin" / "python"


@pytest.mark.slow
def test_the_distributions_hold_what_they_need(built):
    (wheel,), (source,) = built.glob("*.whl"), built.glob("*.tar.gz")
    inside = zipfile.ZipFile(wheel).namelist()
    assert not [name for name in inside if not name.startswith("conformodal")]
    for needed in ("conformodal/py.typed", "conformodal/cli/main.py", "conformodal/conformal/bins.py"):
        assert needed in inside
    with tarfile.open(source) as archive:
        top = {name.split("/")[1] for name in archive.getnames() if "/" in name}
    assert {"src", "tests", "docs", "examples", "README.md", "LICENSE", "CITATION.cff", "pyproject.toml"} <= top


@pytest.mark.slow
def test_the_wheel_answers_in_an_environment_of_its_own(python, small_world, tmp_path):
    where = run(python, "-c", "import conformodal; print(conformodal.__file__)", cwd=tmp_path).strip()
    assert Path(where).is_relative_to(python.parents[1])
    command = python.with_name("conformodal")
    assert run(command, "--version", cwd=tmp_path).strip() == "0.1.0"
    out = tmp_path / "out"
    run(command, "run", small_world.model, small_world.folder, "--part", "test", "--out", out, cwd=tmp_path)
    assert (out / "report.html").is_file()
