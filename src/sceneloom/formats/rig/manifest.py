"""A `rig.toml` as records: parsed, and checked by the table of fields."""

import tomllib
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

from sceneloom.errors import DataError
from sceneloom.formats.files import read_bytes
from sceneloom.formats.rig.faults import Faults
from sceneloom.formats.rig.records import Record, read_record

_NAMED = (("sensors", "id"), ("trajectories", "name"))
_LARGEST_MANIFEST = 16_000_000
_LARGEST_EXPONENT = 40


@dataclass(frozen=True, slots=True)
class Manifest:
    """A manifest that the table of fields finds nothing wrong with.

    Attributes:
        path: the file.
        record: its fields.
    """

    path: Path
    record: Record

    @property
    def ego(self) -> str:
        """The frame that moves through the world."""
        return str(self.record.get("ego", "base"))

    def faults(self) -> Faults:
        """A collection of faults that knows what the parts are called."""
        faults = Faults(self.path)
        for name, key in _NAMED:
            faults.labels.update(
                {location: record[key] for location, record in self.records(name) if key in record}
            )
        return faults

    def records(self, name: str) -> list[tuple[str, Record]]:
        """The tables of a list, each with its location."""
        return [(f"{name}[{k}]", record) for k, record in enumerate(self.record.get(name, []))]


def has_sensors(path: Path) -> bool:
    """Whether a file is TOML with sensors in it."""
    try:
        return "sensors" in _parse(path)
    except DataError:
        return False


def read_manifest(path: Path) -> Manifest:
    """Read a manifest.

    Raises:
        DataError: the file cannot be read, is no TOML, or has faults; all of them are reported at once.
    """
    raw = _parse(path)
    faults = Faults(path)
    record = read_record(raw, "rig", "", faults)
    _check_ids(record, faults)
    faults.raise_all()
    return Manifest(path, record)


def _check_ids(record: Record, faults: Faults) -> None:
    for name, key in _NAMED:
        seen: dict[str, int] = {}
        for k, inner in enumerate(record.get(name, [])):
            identifier = inner.get(key)
            if identifier in seen:
                faults.add(f"{name}[{k}].{key}", f"{identifier!r} is also that of {name}[{seen[identifier]}]")
            elif identifier is not None:
                seen[identifier] = k
    if record.get("sensors") == []:
        faults.add("sensors", "an empty list; expected at least one `[[sensors]]`")


def _parse(path: Path) -> Record:
    try:
        size = path.stat().st_size
        if size > _LARGEST_MANIFEST:
            raise DataError(path, "", f"{size} bytes; expected a manifest of at most {_LARGEST_MANIFEST}")
        text = read_bytes(path).decode("utf-8-sig")
        return tomllib.loads(text.replace("\r\n", "\n"), parse_float=_decimal)
    except OSError as error:
        raise DataError(path, "", f"cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise DataError(path, f"byte {error.start}", "is no UTF-8 text; expected TOML") from error
    except (ValueError, RecursionError) as error:
        broken = "key part" in str(error) or "inline table" in str(error)
        hint = "; a table in { } has to stand in one line" if broken else ""
        raise DataError(path, "", f"is no TOML: {error}{hint}") from error


def _decimal(text: str) -> Decimal:
    """Keep all digits of a number, so that no time is rounded; numbers beyond all reason are infinite or zero."""
    try:
        number = Decimal(text)
    except InvalidOperation:
        return Decimal("Infinity")
    if not number.is_finite() or number == 0:
        return number
    if abs(number.adjusted()) <= _LARGEST_EXPONENT:
        return number
    return Decimal("Infinity") if number.adjusted() > 0 else Decimal(0)
