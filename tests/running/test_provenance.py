import shutil
import subprocess
from pathlib import Path

import pytest

import conformodal
from conformodal.running.results.provenance import provenance, source_revision


@pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")
def test_a_changed_source_is_dirty_and_a_result_just_written_is_no_change(tmp_path):
    def git(*arguments):
        name = ["-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false"]
        return subprocess.run(
            ["git", *name, *arguments], cwd=tmp_path, check=True, capture_output=True, text=True
        ).stdout

    assert source_revision(tmp_path) is None
    source, result = tmp_path / "source.py", tmp_path / "benchmarks" / "results" / "table.md"
    result.parent.mkdir(parents=True)
    source.write_text("1")
    result.write_text("1")
    git("init", "-q")
    assert source_revision(tmp_path) is None  # nothing committed yet
    git("add", ".")
    git("commit", "-qm", "first")
    commit = git("rev-parse", "HEAD")[:12]
    assert source_revision(tmp_path) == commit
    result.write_text("2")
    assert source_revision(tmp_path) == commit
    source.write_text("2")
    assert source_revision(tmp_path) == f"{commit}-dirty"


def test_the_revision_is_that_of_the_checkout_which_the_package_lies_in():
    root = Path(__file__).resolve().parents[2]
    assert (root / "src" / "conformodal" / "__init__.py").samefile(conformodal.__file__)
    assert provenance()["source_revision"] == source_revision(root)
    assert (source_revision(root) is None) == (shutil.which("git") is None or not (root / ".git").exists())
