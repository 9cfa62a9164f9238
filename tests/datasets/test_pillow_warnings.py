import warnings
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from PIL import Image

from conformodal.datasets import read_image
from conformodal.datasets.decoding import ignore_pillow_warnings


def test_threads_that_overlap_leave_the_filters_as_they_were():
    before = list(warnings.filters)
    first, second = ignore_pillow_warnings(), ignore_pillow_warnings()
    first.__enter__()
    second.__enter__()
    first.__exit__(None, None, None)
    second.__exit__(None, None, None)
    assert list(warnings.filters) == before


def test_warnings_of_others_are_not_ignored():
    with ignore_pillow_warnings(), pytest.warns(UserWarning, match="of a reader"):
        warnings.warn("of a reader", UserWarning, stacklevel=1)


def test_images_are_decoded_without_pillows_warnings_and_no_warning_is_lost(tmp_path, monkeypatch):
    path = tmp_path / "large.png"
    Image.fromarray(np.zeros((40, 40, 3), np.uint8)).save(path)
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 1000)  # Pillow warns of 1600
    with pytest.warns(Image.DecompressionBombWarning):
        Image.open(path)
    with warnings.catch_warnings(record=True) as came:
        warnings.simplefilter("always")
        with ThreadPoolExecutor(4) as pool:
            assert all(image.shape == (40, 40, 3) for image in pool.map(read_image, [path] * 200))
        warnings.warn("still heard", UserWarning, stacklevel=1)
    assert [str(one.message) for one in came] == ["still heard"]
