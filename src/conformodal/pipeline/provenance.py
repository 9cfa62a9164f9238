"""What made a result: versions, source revision, time."""

from __future__ import annotations

import platform
import shutil
import subprocess
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

_PACKAGES = ("numpy", "scipy", "onnxruntime", "opencv-python-headless", "poselib", "trimesh", "embreex")


def provenance() -> dict[str, Any]:
    """Versions of this package and of those that decide its numbers, the source revision, machine and time."""
    installed = {name: metadata.version(name) for name in _PACKAGES if any(metadata.distributions(name=name))}
    return {
        "conformodal": metadata.version("conformodal"),
        "source_revision": source_revision(Path(__file__).resolve().parents[3]),
        "packages": installed,  # running a model needs fewer than training one
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}",
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def source_revision(root: Path) -> str | None:
    """Commit of the checkout in `root`, with ``-dirty`` if it was changed; None where there is none.

    Results and pictures of benchmarks do not count: one that was just written says nothing against the next.
    """
    git = shutil.which("git")
    if git is None or not (root / ".git").exists():
        return None

    def answer(*arguments: str) -> str:
        command = [git, "-C", str(root), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=False, timeout=10).stdout.strip()  # noqa: S603

    commit = answer("rev-parse", "--short=12", "HEAD")
    made = (":(exclude)benchmarks/results", ":(exclude)docs/images")
    changed = answer("diff", "--name-only", "HEAD", "--", ".", *made)
    return f"{commit}-dirty" if commit and changed else commit or None
