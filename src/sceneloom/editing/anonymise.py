"""Scenes without the location and, on request, the date of the drive."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from operator import itemgetter
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import read_only
from sceneloom.editing.move_world import FrameChange, moved_world
from sceneloom.editing.references import assumed, skipped, with_ours, with_warnings
from sceneloom.editing.retime import ClockCorrection, retimed_annotation, retimed_sensor, retimed_trajectory
from sceneloom.errors import OptionError
from sceneloom.geometry.geodesy import enu_from_geodetic, geodetic_from_enu
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.motion.ego_trajectory import usable_positions
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.ego import Posed
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.scene import Scene, Sensor, time_span
from sceneloom.scene.time_range import select_rows
from sceneloom.scene.types import Coordinates, key_of
from sceneloom.warnings import DataWarning

_FIXES = ("drop", "shift")
"""What can become of satellite fixes."""

_SOMEWHERE_LLA = (0.0, 0.0, 0.0)
"""Where fixes go: off the coast of Africa, where no drive was."""

_REPORTS = MappingProxyType(
    {
        "magnetometer": "reports where north was",
        "barometer": "reports the height above the sea and the weather",
    }
)
"""Streams that state something of a location."""


def _positions_from_start(scene: Scene, *, fixes: str = "drop") -> Scene:
    """Move the world so that the ego begins at its origin and faces along x; up stays up.

    Args:
        scene: as it is.
        fixes: "drop": satellite receivers go; "shift": their fixes keep their shape, north and height above the first
            one, around latitude 0 and longitude 0; those that are no location go.

    Raises:
        OptionError: there is no such choice.
        DataError: a frame with labelled points cannot be read.
    """
    if fixes not in _FIXES:
        raise OptionError(f"fixes {fixes!r}; expected one of {', '.join(_FIXES)}")
    start = _first_pose(scene)
    moved = scene if start is None else moved_world(scene, FrameChange.constant(start.inverse()))
    receivers = [sensor for sensor in moved.sensors if isinstance(sensor, GnssSensor)]
    shifted = {one.id: one for one in _shifted(receivers)} if fixes == "shift" else {}
    kept = tuple(
        shifted.get(sensor.id, sensor)
        for sensor in moved.sensors
        if sensor.id in shifted or not isinstance(sensor, GnssSensor)
    )
    gone = "satellite fixes" if fixes == "drop" else "fixes that are no location, such as 0, 0"
    warnings = [
        skipped("fixes-left-out", f"sensors[{one.id}]", f"{gone}: left out", count=count)
        for one in receivers
        for count in [len(one.timestamps_ns) - (len(shifted[one.id].timestamps_ns) if shifted else 0)]
    ]
    nowhere = "nothing in it has a pose in the world; positions are relative already"
    warnings.append(assumed("no-poses", "sensors", nowhere, count=int(start is None)))
    return with_warnings(replace(moved, sensors=kept), [*warnings, *_streams_reported(moved)])


def _first_pose(scene: Scene) -> RigidTransform | None:
    """The level pose `world_from_start` at which the ego begins: its location and its heading.

    None without any pose.
    """
    paths: list[Poses | Trajectory] = [one for one in scene.trajectories.values() if len(one.positions)]
    paths += [s.poses for s in scene.sensors if isinstance(s, OdometrySensor)]
    posed = [s for s in scene.sensors if isinstance(s, Posed) and s.coordinates is Coordinates.WORLD]
    paths += [s.poses for s in posed if s.poses is not None]
    if not paths:
        return None
    position, rotation = paths[0].positions[0], paths[0].quaternions_xyzw
    forward = np.array([1.0, 0.0, 0.0])
    if rotation is not None:
        forward = RigidTransform.from_quaternion(np.zeros(3), rotation[0]).rotate(forward)
    heading = float(np.arctan2(forward[1], forward[0]))
    level = np.array([0.0, 0.0, np.sin(heading / 2), np.cos(heading / 2)])
    return RigidTransform.from_quaternion(np.asarray(position, np.float64), level)


def _shifted(receivers: list[GnssSensor]) -> list[GnssSensor]:
    """Put fixes around another location, without those that are none: how far off 0, 0 is would report the true one."""
    usable = [(one, *usable_positions(one)) for one in receivers]
    firsts = [(int(one.timestamps_ns[rows[0]]), locations[0]) for one, rows, locations in usable if len(rows)]
    origin_lla = min(firsts, key=itemgetter(0), default=(0, _SOMEWHERE_LLA))[1]
    found = []
    for one, rows, locations in usable:
        moved = geodetic_from_enu(enu_from_geodetic(locations, origin_lla), _SOMEWHERE_LLA)
        moved[np.isnan(one.positions_lla[rows, 2]), 2] = np.nan
        found.append(replace(select_rows(one, rows), positions_lla=moved))
    return found


def _streams_reported(scene: Scene) -> list[DataWarning]:
    reported: list[DataWarning] = []
    for sensor in scene.sensors:
        streams: Mapping[str, object] = sensor.streams if isinstance(sensor, ImuSensor) else {}
        for name, what in _REPORTS.items():
            if name in streams:
                reported.append(assumed("stream-reports", f"sensors[{sensor.id}].streams.{name}", f"{what}; stays"))
    return reported


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

_OURS_REVEALING = frozenset({"enu_origin", "world_from_file", "cropped", "source", "sources"})
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
class _FieldSweep:
    """Removes revealing fields from a scene, and lists where they were.

    Attributes:
        kinds: what must not be reported.
        found: what was taken out.
        left: what was found and stays.
    """

    kinds: frozenset[str]
    found: list[Telltale] = field(default_factory=list)
    left: list[Telltale] = field(default_factory=list)

    def scene(self, scene: Scene) -> Scene:
        """Give the scene without revealing fields; those of frames are removed when these are read."""
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
        """Give free fields without revealing ones."""
        kept = self._mapping(fields, location)
        same = len(kept) == len(fields) and all(kept[k] is fields[k] for k in kept)
        return fields if same else MappingProxyType(kept)

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
            revealing = [name for name in value if name in _OURS_REVEALING and "location" in self.kinds]
            self.found += [Telltale(f"{location}.{name}", "location") for name in revealing]
            return {name: self._ours(one, f"{location}.{name}") for name, one in value.items() if name not in revealing}
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
        return LazyFrames(frames.timestamps_ns, partial(_swept_frame, frames, self.kinds))

    def _part(self, part: Any, location: str) -> Any:
        changes: dict[str, Any] = {}
        extras = getattr(part, "extras", None)
        if extras:
            changes["extras"] = self.fields(extras, f"{location}.extras")
        attributes = getattr(part, "attributes", ())
        kept = tuple(
            one for one in attributes if not self._goes(one.name, one.values, f"{location}.attributes.{one.name}")
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
            same = len(kept) == len(value) and all(a is b for a, b in zip(kept, value, strict=True))
            return value if same else kept
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
    texts = [one for one in (value if isinstance(value, tuple) else (value,)) if isinstance(one, str)]
    return next((kind for kind, looks in _LOOKS.items() if any(looks(text) for text in texts)), None)


_PATTERNS: Mapping[str, Callable[[str], Any]] = MappingProxyType(
    {kind: re.compile(words).fullmatch for kind, words in _WORDS.items()}
)

_LOOKS: Mapping[str, Callable[[str], Any]] = MappingProxyType(
    {kind: re.compile(pattern).search for kind, pattern in _VALUES.items()}
)


def _swept_frame(frames: LazyFrames[Any], kinds: frozenset[str], k: int) -> Any:
    frame = frames[k]
    extras = _FieldSweep(kinds).fields(frame.extras, "")
    return frame if extras is frame.extras else replace(frame, extras=extras)


def _clock_from_zero(scene: Scene) -> Scene:
    """Give the scene with all times counted from the first timestamp of what was measured.

    Frames are read and moved when asked for. What only a file's own form of times holds goes.
    """
    span_ns = time_span(scene)
    if span_ns is None:
        return replace(scene, time_offset_ns=0)
    # an int, since a float of today's times holds no single nanoseconds
    correction = ClockCorrection(offset_ns=span_ns[0])
    own = {key_of(sensor.id): correction.right for sensor in scene.sensors}
    return replace(
        scene,
        sensors=tuple(_moved(sensor, correction) for sensor in scene.sensors),
        trajectories={
            name: retimed_trajectory(trajectory, correction) for name, trajectory in scene.trajectories.items()
        },
        annotations=tuple(retimed_annotation(one, own, correction.right) for one in scene.annotations),
        attributes=tuple(retimed_annotation(one, own, correction.right) for one in scene.attributes),
        time_offset_ns=0,
    )


def _moved(sensor: Sensor, correction: ClockCorrection) -> Sensor:
    """A sensor with all its times moved, those of its poses too."""
    moved: Any = retimed_sensor(sensor, correction)
    poses = getattr(moved, "poses", None)
    if not isinstance(poses, Poses) or poses.static:
        return sensor if moved is sensor else _typed(moved)
    return _typed(replace(moved, poses=replace(poses, timestamps_ns=read_only(correction.right(poses.timestamps_ns)))))


def _typed(sensor: Any) -> Sensor:
    found: Sensor = sensor
    return found


_ALWAYS = frozenset({"location", "name", "file"})


def anonymised_scene(scene: Scene, *, fixes: str = "drop", dates: str = "keep") -> Scene:
    """Give the scene with positions from where the ego began, and nothing that reports where that was.

    The world's origin is the position of the ego's first pose, its x axis the trajectory it looked; z stays up.
    Satellite receivers go or are put elsewhere. Free fields that report a location, a name or a file are left out, each
    with a warning; of a recording, the lines that were kept word by word.

    Args:
        scene: as it is.
        fixes: "drop" or "shift", see `_positions_from_start`.
        dates: "keep", or "shift": times begin with the drive, and fields that report a date go, too.

    Raises:
        OptionError: there is no such choice.
        DataError: a frame with labelled points cannot be read.
    """
    if dates not in DATES:
        raise OptionError(f"dates {dates!r}; expected one of {', '.join(DATES)}")
    moved = _positions_from_start(scene, fixes=fixes)
    if dates == "shift":
        moved = _clock_from_zero(moved)
    sweep = _FieldSweep(_ALWAYS | {"date"} if dates == "shift" else _ALWAYS)
    swept = with_ours(sweep.scene(moved), relative={"fixes": fixes, "dates": dates})
    return with_warnings(swept, _reported(sweep))


DATES = ("keep", "shift")
"""What can become of the time of day."""


def _reported(sweep: _FieldSweep) -> list[DataWarning]:
    gone = [
        skipped(f"reports-{one.kind}", one.location, f"a field that reports a {one.kind}: left out")
        for one in sweep.found
    ]
    what = "a field that reports a date: stays; `--dates shift` leaves it out"
    return gone + [assumed("reports-date", one.location, what) for one in sweep.left]
