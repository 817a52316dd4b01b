"""The fusion system: pairs what the sensors send, fuses it by a named algorithm, hands results out in order."""

from sceneloom.fusion.configuration import FusionConfiguration
from sceneloom.fusion.system import FusionSystem

__all__ = ["FusionConfiguration", "FusionSystem"]
