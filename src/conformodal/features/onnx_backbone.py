"""Networks in ONNX, run by ONNX Runtime without torch."""

from __future__ import annotations

import hashlib

import numpy as np

from conformodal.core.arrays import Float32Array, UInt8Array
from conformodal.core.extras import require_extra
from conformodal.core.parallel import thread_limit
from conformodal.io import THUMBNAIL

from .backbone import Backbone, BackboneConfig
from .settings import VisionError

INPUT, OUTPUT = "images", "map"


class OnnxBackbone(Backbone):
    """A feature extractor in ONNX.

    The file has the input ``images`` (n, height, width, 3) uint8 and the output ``map`` (n, channels * rows * columns)
    float32.
    """

    def __init__(self, config: BackboneConfig, content: bytes) -> None:
        with require_extra("run", "running a model"):
            import onnxruntime  # noqa: PLC0415 - only where a network is run
        self.config, self.content = config, content
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = thread_limit()
        # idle threads that spin take the cores from tracking and search
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        try:
            self._session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
            shape = self._session.get_inputs()[0].shape[1:]
            names = [node.name for node in (*self._session.get_inputs(), *self._session.get_outputs())]
        except Exception as exc:  # ONNX Runtime raises classes of its own, without a common one
            raise VisionError(f"the network is not an ONNX file that ONNX Runtime reads: {exc}") from exc
        if names != [INPUT, OUTPUT] or shape != [config.height, config.width, 3]:
            raise VisionError(
                f"the network must have the input {INPUT!r} (n, {config.height}, {config.width}, 3) and the output "
                f"{OUTPUT!r}, got {names} and {shape}"
            )

    @property
    def fingerprint(self) -> str:
        """Digest of the ONNX file and of the form of the global descriptor."""
        return hashlib.sha256(self.content + repr(THUMBNAIL).encode()).hexdigest()

    def maps(self, images: UInt8Array) -> Float32Array:
        """The network's features (n, channels * rows * columns) of prepared images (n, h, w, 3).

        Images go in one by one: a batch is no quicker, and rounds otherwise than a stream's single images.
        """
        found = [self._session.run([OUTPUT], {INPUT: image[None]})[0] for image in np.ascontiguousarray(images)]
        return np.concatenate(found)
