"""What coarser measures add to a check."""

import msgspec

from sceneloom.calibrate.health.check import CalibrationHealth
from sceneloom.calibrate.health.verdicts import Item, Verdict

_OFF = (Verdict.WRONG, Verdict.DRIFTING)


def with_coarse(health: CalibrationHealth, item: Item) -> CalibrationHealth:
    """Add what a coarse measure says: it never makes a calibration good, but it may make it doubtful or wrong.

    Where all else calls the calibration good and it does not, nothing can be reported all of it.
    """
    verdict = health.verdict
    if item.verdict in _OFF:
        if verdict is Verdict.GOOD:
            verdict = Verdict.UNDETERMINED
            item = msgspec.structs.replace(item, reason=f"{item.reason}, but the rest agrees with it")
        elif verdict is not Verdict.WRONG:
            verdict = item.verdict
    return msgspec.structs.replace(health, verdict=verdict, items=(*health.items, item))
