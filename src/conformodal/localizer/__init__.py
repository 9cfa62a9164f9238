"""From an image to one belief about its pose, and from beliefs to regions, places and a path."""

from conformodal.core.errors import ConformodalError


class LocalizationError(ConformodalError):
    """Pose sources, candidates, motions or timestamps that cannot be used or do not belong together."""
