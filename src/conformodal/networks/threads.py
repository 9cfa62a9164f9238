"""Limits on the threads of numerical libraries in this process."""

from __future__ import annotations

import cv2
import torch
from threadpoolctl import threadpool_limits

from conformodal.core.threads import set_thread_limit


def limit_threads(threads: int) -> None:
    """Keep torch, ONNX Runtime, OpenCV and linear algebra to so many threads each, for the rest of this process."""
    set_thread_limit(threads)
    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)
    threadpool_limits(threads)
