"""The settings of the fusion system."""

from dataclasses import dataclass, field

from sceneloom.colouring import VisibilitySettings


@dataclass(frozen=True, slots=True, kw_only=True)
class FusionConfiguration:
    """How the fusion system works.

    Attributes:
        fusion_algorithm: a name out of `sceneloom.colouring.ALGORITHMS`.
        pairing_tolerance_ns: how far a picture may be from a sweep's reference time; None for one sweep period.
        lateness_ns: how much later than its time a picture may arrive and still be waited for.
        visibility: what counts as hidden behind a nearer surface.

    Source: DB34/T 4101-2022, table 2 names the algorithm's property.
    """

    fusion_algorithm: str = "projection"
    pairing_tolerance_ns: int | None = None
    lateness_ns: int = 0
    visibility: VisibilitySettings = field(default_factory=VisibilitySettings)
