"""Small pictures of a long source: never more than so many, spread evenly over all frames so far."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from conformodal.core.extras import require_extra

with require_extra("run", "a page of results"):
    import cv2

MOST, WIDTH, QUALITY = 1000, 200, 60


class Thumbnails:
    """JPEG thumbnails by frame name.

    When there are more than `most`, every other one is dropped, and from then on half as many are taken.
    """

    def __init__(self, most: int = MOST, width: int = WIDTH) -> None:
        self.most, self.width = most, width
        self.kept: dict[str, bytes] = {}
        self._stride, self._seen = 1, 0

    def add(self, name: str, image: npt.NDArray[np.uint8]) -> None:
        """Show it the next frame, (h, w, 3) RGB."""
        if self._seen % self._stride == 0:
            height = max(1, round(image.shape[0] * self.width / image.shape[1]))
            small = cv2.resize(image, (self.width, height), interpolation=cv2.INTER_AREA)
            done, data = cv2.imencode(
                ".jpg", cv2.cvtColor(small, cv2.COLOR_RGB2BGR), (cv2.IMWRITE_JPEG_QUALITY, QUALITY)
            )
            if done:
                self.kept[name] = data.tobytes()
            if len(self.kept) > self.most:
                self.kept = {name: data for i, (name, data) in enumerate(self.kept.items()) if i % 2 == 0}
                self._stride *= 2
        self._seen += 1
