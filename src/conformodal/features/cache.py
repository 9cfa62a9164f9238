"""Arrays in cache files, with a digest that detects damage and files of another key."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from conformodal.core.arrays import AnyArray, UInt8Array
from conformodal.core.files import write_whole

_DIGEST = "digest"
Arrays = Mapping[str, AnyArray]


def cache_arrays(path: Path, key: str, arrays: Arrays) -> None:
    """Write arrays with a digest of them and of their key."""
    write_whole(path, save_tensors({**arrays, _DIGEST: _digest(key, arrays)}))


def cached_arrays(path: Path, key: str) -> dict[str, AnyArray] | None:
    """The arrays of a file, or None; a file that is damaged or another key's is removed."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    with suppress(SafetensorError, KeyError, TypeError, ValueError, AttributeError):
        arrays = load_tensors(content)
        if np.array_equal(arrays.pop(_DIGEST), _digest(key, arrays)):
            return arrays
    with suppress(OSError):
        path.unlink()
    return None


def _digest(key: str, arrays: Arrays) -> UInt8Array:
    digest = hashlib.blake2b(key.encode(), digest_size=16)
    for name, array in sorted(arrays.items()):
        digest.update(f"{name} {array.dtype} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return np.frombuffer(digest.digest(), dtype=np.uint8)
