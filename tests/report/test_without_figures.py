"""Where Matplotlib is not installed: models run, and what draws names the extra."""

import subprocess
import sys

import pytest

BLOCKED = "import sys; sys.modules['matplotlib'] = None\n"
NAMED = "needs matplotlib, which is not installed: pip install 'conformodal[figures]'"


def python(script, *arguments):
    command = [sys.executable, "-c", BLOCKED + script, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)


def test_the_picture_of_a_diagnosis_names_the_extra():
    done = python("import conformodal\nconformodal.draw_diagnosis")
    assert done.returncode == 1
    assert f"the picture of a diagnosis {NAMED}" in done.stderr


@pytest.mark.slow
def test_a_model_runs_and_writes_its_page(small_world, tmp_path):
    out = tmp_path / "out"
    script = "from conformodal.cli import main; main()"
    done = python(script, "run", small_world.model, small_world.folder, "--part", "test", "--out", out)
    assert done.returncode == 0, done.stderr
    assert (out / "report.html").is_file()


def test_a_check_with_a_page_is_refused_before_it_begins(small_world, tmp_path):
    out = tmp_path / "out"
    script = "from conformodal.cli import main; main()"
    done = python(script, "data", "check", small_world.folder, "--out", out)
    assert done.returncode == 2
    assert NAMED in done.stderr.replace("\n", " ")
    assert not done.stdout.strip()
    assert not list(out.glob("*.json"))
