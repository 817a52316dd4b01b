"""Free fields that report where, when, by whom or on what a drive was recorded.

Found by their names and their values.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.scene import Scene

_WORDS: Mapping[str, str] = MappingProxyType(
    {
        "location": r"lat|latitude|lon|lng|longitude|lla|gps|gnss|utm|easting|northing|epsg|crs|geo\w*|location|city|"
        r"country|county|address|street|zip|region|origin|world_from_file|map_name",
        "date": r"date|datetime|day|created\w*|recorded\w*|captured\w*|modified|timezone|start_time|end_time",
        "name": r"vin|serial\w*|driver|operator|user\w*|author|owner|annotator|labeler|email|phone|host\w*|ip|mac|"
        r"imei|vehicle|company|token|log|logfile|log_?id|device_?id",
        "file": r"path|paths|file|files|filename|folder|directory|uri|url|source|sources",
    }
)
"""What fields are called that report it, in whole or, but for files, in one of their words."""

_VALUES: Mapping[str, str] = MappingProxyType(
    {
        "date": r"\b(19|20)\d\d[-/.](0?[1-9]|1[0-2])[-/.]([0-2]?\d|3[01])\b",
        "name": r"[\w.+-]+@[\w-]+\.\w+",
        "file": r"^(/|~/|[A-Za-z]:[\\/]|[a-z0-9]+://)\S",
    }
)
"""What texts look like that report it."""

_LINES = (
    "other_lines",
    "other_seconds",
    "further_keys",
    "shared_lines",
    "frame_lines",
)
"""What is kept of a recording's lines word by word, with all its locations and times."""

_RECORDING, _OURS = "recording", "sceneloom"

_OURS_TELLING = frozenset({"enu_origin", "world_from_file", "cropped", "source", "sources"})
"""Entries of our own part of the metadata that report a location or a name; others are numbers that readers need."""


@dataclass(frozen=True, slots=True)
class Telltale:
    """A field that reported something.

    Attributes:
        location: where it was.
        kind: what it reported: "location", "date", "name" or "file".
    """

    location: str
    kind: str


@dataclass(slots=True)
class FieldSweep:
    """Takes telling fields out of a scene, and keeps where they were.

    Attributes:
        kinds: what must not be reported.
        found: what was taken out.
        left: what was found and stays.
    """

    kinds: frozenset[str]
    found: list[Telltale] = field(default_factory=list)
    left: list[Telltale] = field(default_factory=list)

    def scene(self, scene: Scene) -> Scene:
        """Give the scene without telling fields; those of frames are taken out when these are read."""
        attributes = tuple(
            one for one in scene.attributes if not self._goes(one.name, one.values, f"attributes.{one.name}")
        )
        return replace(
            scene,
            sensors=tuple(self._sensor(sensor) for sensor in scene.sensors),
            annotations=tuple(self._part(one, f"annotations[{one.id}]") for one in scene.annotations),
            attributes=attributes,
            metadata=self._metadata(scene.metadata),
            extras=self.fields(scene.extras, "extras"),
        )

    def fields(self, fields: Mapping[str, Any], location: str) -> Mapping[str, Any]:
        """Give free fields without telling ones."""
        kept = self._mapping(fields, location)
        return (
            fields
            if len(kept) == len(fields) and all(kept[k] is fields[k] for k in kept)
            else MappingProxyType(kept)
        )

    def _metadata(self, metadata: Mapping[str, Any]) -> Mapping[str, Any]:
        kept: dict[str, Any] = {}
        for name, value in metadata.items():
            if name == _RECORDING and isinstance(value, Mapping):
                kept[name] = self._recording(value)
            elif name == _OURS and isinstance(value, Mapping):
                kept[name] = self._ours(value, f"metadata.{name}")
            elif not self._goes(name, value, f"metadata.{name}"):
                kept[name] = self._value(value, f"metadata.{name}")
        return MappingProxyType(kept)

    def _recording(self, notes: Mapping[str, Any]) -> Mapping[str, Any]:
        """What is kept of a recording, without its lines: they hold locations and times as they were."""
        lines = [name for name in _LINES if name in notes]
        self.found += [Telltale(f"metadata.{_RECORDING}.{name}", "location") for name in lines]
        others = {name: value for name, value in notes.items() if name not in lines}
        return self.fields(others, f"metadata.{_RECORDING}")

    def _ours(self, value: Any, location: str) -> Any:
        if isinstance(value, Mapping):
            telling = [name for name in value if name in _OURS_TELLING and "location" in self.kinds]
            self.found += [Telltale(f"{location}.{name}", "location") for name in telling]
            return {
                name: self._ours(one, f"{location}.{name}")
                for name, one in value.items()
                if name not in telling
            }
        if isinstance(value, list | tuple):
            return [self._ours(one, f"{location}[{k}]") for k, one in enumerate(value)]
        return value

    def _sensor(self, sensor: Any) -> Any:
        cleaned, location = self._part(sensor, f"sensors[{sensor.id}]"), f"sensors[{sensor.id}]"
        if isinstance(sensor, CameraSensor):
            return replace(cleaned, images=self._frames(sensor.images, f"{location}.images[]"))
        if isinstance(sensor, LidarSensor | RadarSensor):
            return replace(cleaned, frames=self._frames(sensor.frames, f"{location}.frames[]"))
        return cleaned

    def _frames(self, frames: LazyFrames[Any], location: str) -> LazyFrames[Any]:
        if len(frames):
            # what the first one reports stands for all
            self.fields(frames[0].extras, f"{location}.extras")
        return LazyFrames(frames.timestamps_ns, _Swept(frames, self.kinds))

    def _part(self, part: Any, location: str) -> Any:
        changes: dict[str, Any] = {}
        extras = getattr(part, "extras", None)
        if extras:
            changes["extras"] = self.fields(extras, f"{location}.extras")
        attributes = getattr(part, "attributes", ())
        kept = tuple(
            one
            for one in attributes
            if not self._goes(one.name, one.values, f"{location}.attributes.{one.name}")
        )
        if len(kept) < len(attributes):
            changes["attributes"] = kept
        return replace(part, **changes) if changes else part

    def _mapping(self, fields: Mapping[str, Any], location: str) -> dict[str, Any]:
        return {
            name: self._value(value, f"{location}.{name}")
            for name, value in fields.items()
            if not self._goes(str(name), value, f"{location}.{name}")
        }

    def _value(self, value: Any, location: str) -> Any:
        if isinstance(value, Mapping):
            return self.fields(value, location)
        if isinstance(value, list | tuple) and any(isinstance(one, Mapping | str) for one in value):
            kept = [
                self._value(one, f"{location}[{k}]")
                for k, one in enumerate(value)
                if not self._goes("", one, f"{location}[{k}]")
            ]
            return (
                value
                if len(kept) == len(value) and all(a is b for a, b in zip(kept, value, strict=True))
                else kept
            )
        return value

    def _goes(self, name: str, value: Any, location: str) -> bool:
        kind = kind_of(name, value)
        if kind is None:
            return False
        goes = kind in self.kinds
        (self.found if goes else self.left).append(Telltale(location, kind))
        return goes


def kind_of(name: str, value: Any) -> str | None:
    """What a field reports: "location", "date", "name" or "file"; None where it seems to state nothing."""
    if value is None or isinstance(value, bool):
        return None
    called = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower().replace("-", "_")
    for kind, words in _PATTERNS.items():
        parts = {called} if kind == "file" else {called, *called.split("_")}
        if any(words(part) for part in parts):
            return kind
    texts = (
        [value]
        if isinstance(value, str)
        else [v for v in value if isinstance(v, str)]
        if isinstance(value, tuple)
        else []
    )
    return next((kind for kind, looks in _LOOKS.items() if any(looks(text) for text in texts)), None)


_PATTERNS: Mapping[str, Callable[[str], Any]] = MappingProxyType(
    {kind: re.compile(words).fullmatch for kind, words in _WORDS.items()}
)
_LOOKS: Mapping[str, Callable[[str], Any]] = MappingProxyType(
    {kind: re.compile(pattern).search for kind, pattern in _VALUES.items()}
)


@dataclass(frozen=True, slots=True, eq=False)
class _Swept:
    """Reads frames without telling fields; what `LazyFrames` asks for."""

    frames: LazyFrames[Any]
    kinds: frozenset[str]

    def __call__(self, k: int) -> Any:
        frame = self.frames[k]
        extras = FieldSweep(self.kinds).fields(frame.extras, "")
        return frame if extras is frame.extras else replace(frame, extras=extras)
