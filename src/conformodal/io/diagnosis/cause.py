"""What a diagnosis says."""

from __future__ import annotations

from typing import NamedTuple


class Cause(NamedTuple):
    """Why data do not fit together: the cause, the evidence for it, and what to do."""

    what: str
    evidence: str
    remedy: str = ""

    def __str__(self) -> str:
        return f"{self.what} ({self.evidence}){f'; {self.remedy}' if self.remedy else ''}"
