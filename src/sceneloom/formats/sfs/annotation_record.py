"""A record of an annotation on its way into the model: its checked values, and where its faults and warnings go."""

from dataclasses import dataclass
from typing import Any

from sceneloom.formats.sfs.annotation_parts import Record, further, read_attributes
from sceneloom.formats.sfs.records import Faults, Location
from sceneloom.formats.sfs.source import Source
from sceneloom.scene.types import Identifier
from sceneloom.scene.warnings import WarningKind


@dataclass(frozen=True, slots=True)
class AnnotationRecord:
    """One annotation of the file.

    Attributes:
        source: the file.
        values: its fields, checked by the table of fields, times in nanoseconds.
        location: where it stands.
        faults: takes what is wrong, with locations below it.
    """

    source: Source
    values: Record
    location: Location
    faults: Faults

    @property
    def id(self) -> Identifier:
        """Its id."""
        identifier: Identifier = self.values["id"]
        return identifier

    def fields(self, *names: str, taken: tuple[str, ...] = ()) -> dict[str, Any]:
        """Give fields that pass as they are, `attributes`, and all others but those taken as `extras`."""
        fields = {name: self.values.get(name) for name in names}
        fields["extras"] = further(self.values, "id", "type", *names, *taken)
        if "attributes" in fields:
            fields["attributes"] = read_attributes(fields["attributes"], self.faults)
        return fields

    def note_flat(self, *below: str | int) -> None:
        """Report that a path in space has pairs for locations."""
        message = "pairs where locations in the world were expected; their z is taken as 0"
        self.source.warning(WarningKind.ASSUMED, "no-height", (*self.location, *below), message)
