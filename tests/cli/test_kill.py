"""Commands that are killed at some moment: earlier results stay whole, and the same command then comes to its end."""

import os
import random
import shutil
import signal
import subprocess
import sys
import time

import pytest

from conformodal.pipeline.results import read_run
from conformodal.pipeline.store import load_model
from tests.helpers import contents

LOG = "conformodal.log"
MAIN = "from conformodal.cli.main import app; app()"
SIGNALS = {"kill -9": signal.SIGKILL, "SIGTERM": signal.SIGTERM}


def start(*arguments) -> subprocess.Popen:
    command = [sys.executable, "-c", MAIN, *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ)


def wait_for(process, ready) -> None:
    end = time.monotonic() + 120
    while time.monotonic() < end and process.poll() is None and not ready():
        time.sleep(0.02)


@pytest.mark.slow
@pytest.mark.parametrize("how", SIGNALS)
def test_a_stopped_run_keeps_its_answers(small_world, tmp_path, how):
    run = ["run", small_world.model, small_world.folder, "--out", tmp_path / "out"]
    moment = random.Random(how).randint(3, 12)
    regions = tmp_path / "out" / "regions.jsonl.part"
    process = start(*run)
    wait_for(process, lambda: regions.is_file() and regions.read_bytes().count(b"\n") >= moment)
    process.send_signal(SIGNALS[how])
    output, errors = process.communicate(timeout=120)
    assert "Traceback" not in errors
    if how == "kill -9":
        assert process.returncode == -signal.SIGKILL
        assert regions.read_bytes().count(b"\n") >= moment
        assert not (tmp_path / "out" / "metrics.json").exists()
        return
    assert process.returncode == 128 + SIGNALS[how], (output, errors)
    result = read_run(tmp_path / "out")
    assert result.metrics["stopped"] == "interrupted"
    assert len(result.records) >= moment
    assert not regions.exists()
    assert not (tmp_path / "out" / ".lock").exists()


@pytest.mark.slow
@pytest.mark.parametrize("how", ["kill -9", "SIGTERM"])
def test_a_training_that_is_stopped_leaves_the_model_before(small_world, tmp_path, how):
    model = shutil.copytree(small_world.model, tmp_path / "m")
    before = contents(model)
    options = ["--cache", small_world.cache, "--epochs", "4000", "--sources", "head"]
    process = start("train", small_world.folder, "--out", model, *options)
    wait_for(process, (model / ".lock").exists)
    time.sleep(random.Random(how).random())
    process.send_signal(SIGNALS[how])
    _, errors = process.communicate(timeout=120)
    assert process.returncode in (-signal.SIGKILL, 128 + signal.SIGTERM)
    assert "Traceback" not in errors
    assert {k: v for k, v in contents(model).items() if k != ".lock"} | {LOG: before[LOG]} == before
    load_model(model)
