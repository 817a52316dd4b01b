"""The fusion system: pairs what the sensors send, fuses it by a named algorithm, hands results out in order."""

from typing import TYPE_CHECKING

from sceneloom.lazy import names_on_first_use

if TYPE_CHECKING:
    from sceneloom.fusion.configuration import FusionConfiguration
    from sceneloom.fusion.system import FusionSystem
else:
    __getattr__, __dir__ = names_on_first_use(
        __name__, {"configuration": "FusionConfiguration", "system": "FusionSystem"}
    )

__all__ = ["FusionConfiguration", "FusionSystem"]
