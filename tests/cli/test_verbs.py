import json
import subprocess
import sys

import pytest

from conformodal.cli import info as info_module
from conformodal.pipeline.guarantee import describe_guarantee
from conformodal.pipeline.store import load_model
from tests.helpers import invoke


@pytest.mark.parametrize(
    ("commands", "heavy"),
    [([()], ("torch", "scipy", "sklearn", "cv2", "matplotlib")), ([("train",), ("run",)], ("torch",))],
)
def test_help_imports_nothing_heavy(commands, heavy):
    script = "import sys; from contextlib import suppress; from conformodal.cli.main import app\n"
    script += f"for words in {commands}:\n with suppress(SystemExit): app([*words, '--help'])\n"
    script += f"print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.count("Usage") == len(commands)
    assert done.stdout.splitlines()[-1] == "[]"


def test_info_names_training_data_guarantee_and_size(small_world):
    found = json.loads(invoke("info", small_world.model, "--json").stdout)
    model = load_model(small_world.model)
    assert found["frames"] == {part: len(model.split.part(part)) for part in ("train", "calibration", "test")}
    assert found["alpha"] == 0.2
    assert found["sources"] == list(model.settings["sources"])
    assert found["network_ms"] > 0
    (weights,) = small_world.model.glob("weights-*")
    assert found["bytes"][weights.name] == weights.stat().st_size
    assert set(found["bounded_regions"]) == {kind.name.lower() for kind in model.rules.by_type}
    lines = info_module.describe_facts(found)
    assert found["guarantee"] == describe_guarantee(model) in lines
    assert invoke("info", small_world.model).stdout.replace("\n", "").startswith(lines[0])
