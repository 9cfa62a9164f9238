"""The order of causes: what was found while reading is cheaper than images, and explains what they show.

- A camera of other images, times in another unit, and values that repeat are told where a file is read
  (:mod:`cameras`, :mod:`clocks`, :mod:`columns`, :mod:`stale`); poses that repeat are taken away there.
- Then :mod:`images` asks whether the poses that are left fit.
"""

from __future__ import annotations

from conformodal.io.recording import Recording

from .cameras import UNLIKELY_CAMERA
from .cause import Cause
from .images import diagnose_poses


def diagnose(recording: Recording) -> Cause | None:
    """The one cause why poses do not fit their images; None where they do, or where too little can be compared."""
    cause = diagnose_poses(recording)
    camera = next((note.where for note in recording.notes if note.what == UNLIKELY_CAMERA), None)
    if cause is None or camera is None:
        return cause
    return Cause(f"the camera is unlikely: {camera}", cause.evidence, "correct it before the poses are looked at")
