"""Making the header of a file out of everything that was given to its writer."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from sceneloom.arrays import AnyArray
from sceneloom.formats.loss import Support
from sceneloom.formats.sfs.clock_keeper import ClockKeeper
from sceneloom.formats.sfs.drafts import Losses, SensorDraft
from sceneloom.formats.sfs.encoding import Items, RecordWriter, encode_header
from sceneloom.formats.sfs.exactness import simplified_attributes, thousandths
from sceneloom.formats.sfs.fields import annotation_record, sensor_record
from sceneloom.formats.sfs.profiles import Profile, attribute_fits
from sceneloom.formats.sfs.reading import DEFAULT_EULER
from sceneloom.formats.sfs.records import Location
from sceneloom.formats.sfs.root import OURS
from sceneloom.formats.sfs.spool import Blob, Spool
from sceneloom.formats.sfs.times import TICKS_NS
from sceneloom.scene.types import Identifier

VERSION = "1.0"
LAYOUT = 1
"""Number of the layout of our metadata."""

_UNIT_OF = {tick_ns: unit for unit, tick_ns in TICKS_NS.items()}
_EVERYWHERE = "sensors[], annotations[], attributes[]"
_ROUNDING = 0.5
"""How far a time is off at most where it is rounded [µs]."""


@dataclass(slots=True)
class Contents:
    """Everything that a writer was given, arrays of frames spooled already.

    Attributes:
        drafts: the sensors, by id.
        annotations: their records.
        attributes: of the scene and its sensors.
        metadata: free fields.
        ours: fields of our entry of the metadata.
        extras: further root fields.
        time_unit: how the unit is spelt; None for the usual spelling.
    """

    drafts: dict[tuple[type, Identifier], SensorDraft] = field(default_factory=dict)
    annotations: list[dict[str, Any]] = field(default_factory=list)
    attributes: list[Mapping[str, Any]] = field(default_factory=list)
    metadata: dict[str, Any] = field(default_factory=dict)
    ours: dict[str, Any] = field(default_factory=dict)
    extras: dict[str, Any] = field(default_factory=dict)
    time_unit: str | None = None


class _Recorder:
    """Spools the arrays of a first pass over everything, and remembers where each stands."""

    def __init__(self, spool: Spool) -> None:
        self.spool = spool
        self.known: dict[int, tuple[AnyArray, Blob]] = {}

    def add(self, array: AnyArray) -> Blob:
        """Spool one array."""
        blob = self.spool.add(array)
        self.known[id(array)] = (array, blob)
        return blob


class _Replay:
    """Gives the blobs of a first pass again, each once; an array made anew is spooled anew."""

    def __init__(self, first: _Recorder) -> None:
        self._first = first

    def add(self, array: AnyArray) -> Blob:
        """Find or spool one array."""
        known = self._first.known.pop(id(array), None)
        return self._first.spool.add(array) if known is None else known[1]


def assemble(contents: Contents, profile: Profile, keeper: ClockKeeper, losses: Losses) -> bytes:
    """Make the header.

    Raises:
        OptionError: something cannot be held by the format.
    """
    firsts = [first for draft in contents.drafts.values() if (first := draft.first_ns()) is not None]
    if firsts:
        keeper.clock_for(min(firsts))
    recorder = _Recorder(keeper.spool)
    passed = _Pass(contents, profile, RecordWriter(keeper.clock, recorder))
    header = passed.header()
    if passed.writer.lowest < 0:
        # a time that stands only in annotations or attributes is earlier than all frames and poses
        keeper.clock_for(passed.writer.lowest * keeper.tick_ns + keeper.clock.offset_ns)
        passed = _Pass(contents, profile, RecordWriter(keeper.clock, _Replay(recorder)))
        header = passed.header()
    losses.add_all(passed.losses)
    return encode_header(header, passed.items)


@dataclass(slots=True)
class _Pass:
    """One attempt at the header."""

    contents: Contents
    profile: Profile
    writer: RecordWriter
    losses: Losses = field(default_factory=Losses)
    items: Items = field(default_factory=list)

    def header(self) -> dict[str, Any]:
        """Write everything; the locations of arrays are left empty."""
        clock = self.writer.clock
        header: dict[str, Any] = {
            "version": VERSION,
            "time_unit": self.contents.time_unit or _UNIT_OF[clock.tick_ns],
            "time_offset": max(clock.offset_ns, 0) // clock.tick_ns,
        }
        header["sensors"], sensors_aside, notes = self._sensors()
        header["annotations"], annotations_aside, exact = self._annotations()
        header["attributes"], attributes_aside, exact_of_scene = self._attributes()
        header["metadata"] = self._metadata()
        ours = self._ours(
            {
                **self.contents.ours,
                "time_shift_ns": -clock.offset_ns if clock.offset_ns < 0 else None,
                "sensor_notes": notes or None,
                "attributes": attributes_aside or None,
                "exact_attributes": exact_of_scene + exact or None,
            },
            {
                "sensors": (sensors_aside, sensor_record),
                "annotations": (annotations_aside, annotation_record),
            },
        )
        if ours:
            header["metadata"][OURS] = {"layout": LAYOUT, **ours}
        further = {name: value for name, value in self.contents.extras.items() if name not in header}
        self._count_rounding()
        return {**header, **self._written(further, "scene", ())}

    def _metadata(self) -> dict[str, Any]:
        inner: Items = []
        written = self.writer.plain_object(self.contents.metadata, inner)
        self.items.extend((("metadata", *keys), blob) for keys, blob in inner)
        return written

    def _ours(self, fields: Mapping[str, Any], aside: Mapping[str, tuple[list[Any], Any]]) -> dict[str, Any]:
        """Write our entry of the metadata, and in it what the format or the profile has no field for."""
        location: Location = ("metadata", OURS)
        written = self._written(fields, OURS, location)
        for name, (records, record_of) in aside.items():
            if records:
                written[name] = self._list(records, (*location, name), record_of)
        return written

    def _written(self, record: Mapping[str, Any], name: str, location: Location) -> dict[str, Any]:
        inner: Items = []
        written = self.writer.write(record, name, inner)
        self.items.extend(((*location, *keys), blob) for keys, blob in inner)
        return written

    def _list(
        self, records: list[dict[str, Any]], location: Location, record_of: Any
    ) -> list[dict[str, Any]]:
        return [
            self._written(record, record_of(record["type"]), (*location, index))
            for index, record in enumerate(records)
        ]

    def _sensors(self) -> tuple[list[Any], list[dict[str, Any]], list[dict[str, Any]]]:
        """Write the sensors; give those that must stand aside, and the notes."""
        kept: list[dict[str, Any]] = []
        aside: list[dict[str, Any]] = []
        notes: list[dict[str, Any]] = []
        for draft in self.contents.drafts.values():
            record = draft.record(self.writer.clock, self.losses)
            obstacle = self.profile.sensor_obstacle(record, self.writer.clock)
            (kept if obstacle is None else aside).append(record)
            if obstacle is not None:
                self.losses.add(draft.location, obstacle, kept="metadata.sceneloom.sensors")
            if draft.note:
                notes.append({"id": draft.id, **draft.note})
        return self._list(kept, ("sensors",), sensor_record), aside, notes

    def _annotations(self) -> tuple[list[Any], list[dict[str, Any]], list[Mapping[str, Any]]]:
        """Write the annotations; give those that must stand aside, and the exact attributes."""
        kept: list[dict[str, Any]] = []
        aside: list[dict[str, Any]] = []
        exact: list[Mapping[str, Any]] = []
        for record in self.contents.annotations:
            simple, exact_records = self._simplified(record)
            obstacle = self.profile.annotation_obstacle(simple)
            if obstacle is None:
                kept.append(simple)
                exact += exact_records
            else:
                aside.append(record)
                where = "metadata.sceneloom.annotations"
                self.losses.add(f"annotations[{record['type']}]", obstacle, kept=where)
        self._note_exact(exact, "annotations[].attributes[]")
        return self._list(kept, ("annotations",), annotation_record), aside, exact

    def _simplified(self, record: dict[str, Any]) -> tuple[dict[str, Any], list[Mapping[str, Any]]]:
        attributes = record.get("attributes")
        if self.profile.exact_attributes or not isinstance(attributes, list | tuple):
            return record, []
        simple, exact = simplified_attributes(attributes, record["id"])
        return {**record, "attributes": simple}, exact

    def _attributes(self) -> tuple[list[Any], list[Mapping[str, Any]], list[Mapping[str, Any]]]:
        """Write the scene's attributes; give those that must stand aside, and the exact ones."""
        if self.profile.exact_attributes:
            return self._written({"attributes": self.contents.attributes}, "scene", ())["attributes"], [], []
        fitting: list[Mapping[str, Any]] = []
        aside: list[Mapping[str, Any]] = []
        for attribute in self.contents.attributes:
            (fitting if attribute_fits(thousandths(attribute)) else aside).append(attribute)
        simple, exact = simplified_attributes(fitting, None)
        what = "Scale's loader takes text and integers only"
        self.losses.add("attributes[]", what, count=len(aside), kept="metadata.sceneloom.attributes")
        self._note_exact(exact, "attributes[]")
        return self._written({"attributes": simple}, "scene", ())["attributes"], aside, exact

    def _note_exact(self, exact: list[Mapping[str, Any]], where: str) -> None:
        what = "made integers (fractions in thousandths), static ones with one time stamp"
        self.losses.add(where, what, count=len(exact), kept="metadata.sceneloom.exact_attributes")

    def _count_rounding(self) -> None:
        what = "times rounded to whole microseconds, halves to even: at most 0.5 µs off"
        self.losses.add(
            _EVERYWHERE, what, count=self.writer.rounded, support=Support.CONVERTED, largest_error=_ROUNDING
        )
        what = "numbers that are infinite or none, written as null"
        self.losses.add(_EVERYWHERE, what, count=self.writer.not_numbers)


def with_euler(contents: Contents) -> None:
    """Record how the angles of cuboids are meant, where there are cuboids and nothing says it."""
    if any(record["type"] == "cuboid" for record in contents.annotations):
        contents.ours = {**DEFAULT_EULER, **contents.ours}
