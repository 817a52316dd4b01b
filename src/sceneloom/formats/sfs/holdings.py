"""What scene files hold of a scene: all that the model can hold; what depends on the scene is told while writing."""

from types import MappingProxyType

from sceneloom.formats.holdings import Holds
from sceneloom.formats.loss import KEPT, converted, dropped

HOLDS: Holds = MappingProxyType(
    {
        "": KEPT,
        "sensors.depth_camera": dropped("the format has no cameras that measure depth"),
        "time_offset_ns": converted(
            "chosen anew, so that small numbers are written; every time stays the same"
        ),
    }
)
