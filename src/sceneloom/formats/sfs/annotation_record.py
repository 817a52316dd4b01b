"""A record of an annotation on its way into the model: its checked values, and where its faults and notices go."""

from dataclasses import dataclass
from typing import Any

from sceneloom.formats.sfs.annotation_parts import Record, further, read_attributes
from sceneloom.formats.sfs.records import Faults, Place
from sceneloom.formats.sfs.source import Source
from sceneloom.scene.notices import NoticeKind
from sceneloom.scene.types import Identifier


@dataclass(frozen=True, slots=True)
class AnnotationRecord:
    """One annotation of the file.

    Attributes:
        source: the file.
        values: its fields, checked by the table of fields, times in nanoseconds.
        place: where it stands.
        faults: takes what is wrong, with places below it.
    """

    source: Source
    values: Record
    place: Place
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
        """Tell that a path in space has pairs for places."""
        message = "pairs where places in the world were expected; their z is taken as 0"
        self.source.notice(NoticeKind.ASSUMED, "no-height", (*self.place, *below), message)
