"""From videos without poses to a recording with poses: structure from motion by pycolmap (extra ``colmap``).

:func:`build_map` does it all. Videos become frames and keyframes (:mod:`.clips`, :mod:`.keyframes`), keyframes are
matched (:mod:`.matching`) and become a map (:mod:`.structure`), the other frames are registered against it
(:mod:`.registration`), the map is judged (:mod:`.verdict`), brought to metres and upright axes (:mod:`.world`), and
written in COLMAP's layout (:mod:`.writing`).
"""

from .build import MapReport, build_map
from .settings import MapError, MapSettings
from .verdict import MapQuality, Reason
from .world import KnownLength, Placement

__all__ = ["KnownLength", "MapError", "MapQuality", "MapReport", "MapSettings", "Placement", "Reason", "build_map"]
