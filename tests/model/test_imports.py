"""What is imported, and what is not."""

import subprocess
import sys
import textwrap

import pytest


def run(script):
    script = textwrap.dedent(script)
    return subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False, timeout=300)


@pytest.mark.parametrize("module", ["region_rules", "radius", "errors"])
def test_rules_of_regions_and_radii_need_no_package_for_images(module):
    found = run(f"""
        import sys
        import conformodal.model.{module}
        heavy = {{"cv2", "PIL", "onnxruntime", "poselib", "safetensors", "torch"}} & set(sys.modules)
        assert not heavy, heavy
    """)
    assert found.returncode == 0, found.stderr


def test_settings_are_checked_without_torch():
    found = run("""
        import sys

        sys.modules["torch"] = None  # its import fails
        from conformodal.model.config import ModelConfig
        from conformodal.vision.settings import VisionError

        ModelConfig(), ModelConfig(network="hf:someone/something"), ModelConfig.paper(device="cuda")
        for wrong in ({"network": "efficientnet_lite9"}, {"device": "tpu"}):
            try:
                ModelConfig(**wrong)
            except VisionError as exc:
                assert next(iter(wrong.values())) in str(exc)
            else:
                raise AssertionError(wrong)
    """)
    assert found.returncode == 0, found.stderr
