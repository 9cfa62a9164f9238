import numpy as np
import pytest

from conformodal.experiments import ExperimentError, load_classical, save_classical


def test_saved_regressor_gives_the_same_answers_and_damage_is_named(small_world, tmp_path):
    regressor = load_classical(small_world.model)
    save_classical(regressor, tmp_path)
    back = load_classical(tmp_path)
    x = np.random.default_rng(0).random((3, len(regressor.head.offset))).astype(np.float32)
    np.testing.assert_array_equal(regressor.predict(x), back.predict(x))
    assert back.training == regressor.training
    path = tmp_path / "classical.safetensors"
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(ExperimentError, match="digest differs"):
        load_classical(tmp_path)
    path.unlink()
    with pytest.raises(ExperimentError, match="cannot be used"):
        load_classical(tmp_path)


def test_no_regressor_is_no_error(tmp_path):
    assert load_classical(tmp_path) is None
