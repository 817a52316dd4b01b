"""What an MCAP file makes of each field of a scene."""

from collections.abc import Mapping
from types import MappingProxyType

from sceneloom.formats.loss import KEPT, Holding
from sceneloom.formats.topics.holdings import TOPIC_HOLDS, dropped_here

HOLDS: Mapping[str, Holding] = MappingProxyType(
    {**TOPIC_HOLDS, "trajectories.covariances": dropped_here("messages of poses have none"), "": KEPT}
)
