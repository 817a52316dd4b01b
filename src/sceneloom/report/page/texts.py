"""Numbers as a person reads them."""

from sceneloom.scene.warnings import DataWarning

NOTHING = "–"


def count(value: float | None) -> str:
    """A whole number with its thousands apart."""
    return NOTHING if value is None else f"{value:,.0f}"


def several(value: int, noun: str) -> str:
    """A count with its noun."""
    return f"{value:,} {noun}" if value == 1 else f"{value:,} {noun}s"


def fixed(value: float | None, digits: int, unit: str = "") -> str:
    """A number with so many digits behind the point, and its unit."""
    if value is None:
        return NOTHING
    return f"{round(value, digits) + 0.0:,.{digits}f}{f' {unit}' if unit else ''}"


def percent(share: float | None, digits: int = 1) -> str:
    """A share of 1 in per cent."""
    return NOTHING if share is None else f"{100.0 * share:.{digits}f} %"


def megabytes(size_bytes: int | None) -> str:
    """Bytes in a unit that reads well."""
    if size_bytes is None:
        return NOTHING
    for unit, scale in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if size_bytes >= scale:
            return f"{size_bytes / scale:.1f} {unit}"
    return f"{size_bytes} bytes"


def joined(*parts: str | None) -> str:
    """Parts that there are, with colons between."""
    return ": ".join(part for part in parts if part)


def times(value: int) -> str:
    """How often, where that is more than once."""
    return f" ({value:,} times)" if value > 1 else ""


def warning_text(warning: DataWarning) -> str:
    """A warning in one line."""
    return joined(str(warning.kind), warning.location, warning.message) + times(warning.count)
