"""Where what can be made again is kept."""

from __future__ import annotations

import os
from pathlib import Path


def default_cache_dir() -> Path:
    """``$CONFORMODAL_CACHE``, or ``conformodal`` under the user's cache directory."""
    if "CONFORMODAL_CACHE" in os.environ:
        return Path(os.environ["CONFORMODAL_CACHE"])
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "conformodal"
