"""Scenes without the location and, on request, the date of the drive."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from operator import itemgetter
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.editing.move_world import FrameChange, moved_world
from sceneloom.editing.references import LINES, WHOLE_LABELS, with_ours, with_warnings, without, without_fields
from sceneloom.editing.retime import clock_from_zero
from sceneloom.errors import check_choice
from sceneloom.geometry.geodesy import enu_from_geodetic, geodetic_from_enu
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.motion.ego_trajectory import usable_positions
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.scene import Posed, Scene
from sceneloom.scene.time_range import select_rows
from sceneloom.scene.types import Coordinates
from sceneloom.warnings import DataWarning, assumed, skipped

DATES = ("keep", "shift")
"""What can become of the time of day."""

_FIXES = ("drop", "shift")  # what can become of satellite fixes
_SHIFTED_LLA = (0.0, 0.0, 0.0)  # where fixes are moved: off the coast of Africa, where no drive was


def anonymised_scene(scene: Scene, *, fixes: str = "drop", dates: str = "keep") -> Scene:
    """Give the scene with positions relative to the start, and nothing that reports where that was.

    The world's origin is the position of the ego's first pose, and its x axis the heading there; z stays up. Satellite
    receivers are removed or moved elsewhere. Extra fields that report a location, a name or a file are left out, each
    with a warning; of a recording, the lines that are kept as text.

    Args:
        scene: the scene.
        fixes: "drop": satellite receivers are removed; "shift": their fixes keep their shape, north and height above
            the first one, around latitude 0 and longitude 0; those that are no location are removed.
        dates: "keep", or "shift": times begin with the drive, and fields that report a date are removed, too.

    Raises:
        OptionError: there is no such choice.
        DataError: a frame with labelled points cannot be read.
    """
    check_choice("dates", dates, DATES)
    check_choice("fixes", fixes, _FIXES)
    moved = _with_positions_from_start(scene, fixes)
    kinds = {"location", "name", "file"}
    if dates == "shift":
        moved, kinds = clock_from_zero(moved), kinds | {"date"}
    fields = _RevealingFields(frozenset(kinds))
    swept = with_ours(fields.removed(moved), relative={"fixes": fixes, "dates": dates})
    return with_warnings(swept, [*fields.gone, *fields.left])


def _with_positions_from_start(scene: Scene, fixes: str) -> Scene:
    """Move the world so that the ego begins at its origin and faces along x; up stays up."""
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
    counts = {one.id: len(one.timestamps_ns) for one in receivers}
    left = {one.id: len(one.timestamps_ns) for one in shifted.values()}
    unposed = "nothing in it has a pose in the world; positions are relative already"
    warnings = [
        *(
            skipped(
                "fixes-left-out", f"sensors[{identifier}]", f"{gone}: left out", count=count - left.get(identifier, 0)
            )
            for identifier, count in counts.items()
        ),
        assumed("no-poses", "sensors", unposed, count=int(start is None)),
    ]
    for sensor in moved.sensors:
        for name, what in _REVEALING_STREAMS.items() if isinstance(sensor, ImuSensor) else ():
            if name in sensor.streams:  # type: ignore[union-attr]
                warnings.append(assumed("stream-reports", f"sensors[{sensor.id}].streams.{name}", f"{what}; stays"))
    return with_warnings(replace(moved, sensors=kept), warnings)


_REVEALING_STREAMS = MappingProxyType(
    {"magnetometer": "reports where north was", "barometer": "reports the height above the sea and the weather"}
)  # streams that report something of a location


def _first_pose(scene: Scene) -> RigidTransform | None:
    """The level pose `world_from_start` of the ego's first position and heading; None without any pose."""
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
    """Move fixes elsewhere, without those that are none: their distance from 0, 0 would reveal the true location."""
    usable = [(one, *usable_positions(one)) for one in receivers]
    firsts = [(int(one.timestamps_ns[rows[0]]), positions[0]) for one, rows, positions in usable if len(rows)]
    origin_lla = min(firsts, key=itemgetter(0), default=(0, _SHIFTED_LLA))[1]
    found = []
    for one, rows, positions in usable:
        moved = geodetic_from_enu(enu_from_geodetic(positions, origin_lla), _SHIFTED_LLA)
        moved[np.isnan(one.positions_lla[rows, 2]), 2] = np.nan
        found.append(replace(select_rows(one, rows), positions_lla=moved))
    return found


# Fields that reveal something.

_NAMES: Mapping[str, Callable[[str], Any]] = MappingProxyType(
    {
        "location": re.compile(
            r"lat|latitude|lon|lng|longitude|lla|gps|gnss|utm|easting|northing|epsg|crs|geo\w*|location|city|"
            r"country|county|address|street|zip|region|origin|world_from_file|map_name"
        ).fullmatch,
        "date": re.compile(
            r"date|datetime|day|created\w*|recorded\w*|captured\w*|modified|timezone|start_time|end_time"
        ).fullmatch,
        "name": re.compile(
            r"vin|serial\w*|driver|operator|user\w*|author|owner|annotator|labeler|email|phone|host\w*|ip|mac|"
            r"imei|vehicle|company|token|log|logfile|log_?id|device_?id"
        ).fullmatch,
        "file": re.compile(r"path|paths|file|files|filename|folder|directory|uri|url|source|sources").fullmatch,
    }
)  # names of fields that report something, by what that is: the whole name or, but for files, one of its words

_VALUES: Mapping[str, Callable[[str], Any]] = MappingProxyType(
    {
        "date": re.compile(r"\b(19|20)\d\d[-/.](0?[1-9]|1[0-2])[-/.]([0-2]?\d|3[01])\b").search,
        "name": re.compile(r"[\w.+-]+@[\w-]+\.\w+").search,
        "file": re.compile(r"^(/|~/|[A-Za-z]:[\\/]|[a-z0-9]+://)\S").search,
    }
)  # texts that report something

_KEPT_TEXTS = frozenset(
    f"metadata.{LINES}.{name}"
    for name in ("other_lines", "other_seconds", "further_keys", "shared_lines", "frame_lines")
) | {f"metadata.{'.'.join(WHOLE_LABELS)}"}
"""Where lines of a recording, or a whole file of labels, are kept as text, with their original locations and times."""

_OURS_REVEALING = frozenset({"enu_origin", "world_from_file", "cropped", "source", "sources"})
"""Entries of our own part of the metadata that report a location or a name; others are numbers that readers need."""


def kind_of(name: str, value: Any) -> str | None:
    """What a field reports: "location", "date", "name" or "file"; None where it seems to reveal nothing."""
    if value is None or isinstance(value, bool):
        return None
    called = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower().replace("-", "_")
    for kind, is_word in _NAMES.items() if called else ():
        if any(map(is_word, {called} if kind == "file" else {called, *called.split("_")})):
            return kind
    texts = [one for one in (value if isinstance(value, tuple) else (value,)) if isinstance(one, str)]
    return next((kind for kind, looks in _VALUES.items() if any(map(looks, texts))), None)


@dataclass(slots=True)
class _RevealingFields:
    """Removes revealing fields from a scene, and lists where they were."""

    kinds: frozenset[str]  # what must not be reported
    gone: list[DataWarning] = field(default_factory=list)  # about what was removed
    left: list[DataWarning] = field(default_factory=list)  # about what was found and stays

    def removed(self, scene: Scene) -> Scene:
        """Give the scene without revealing fields; those of frames are removed when these are read."""
        bare = without_fields(scene, self.goes)
        return replace(
            bare,
            sensors=tuple(map(self._with_bare_frames, bare.sensors)),
            annotations=tuple(self._with_bare_attributes(one, f"annotations[{one.id}].") for one in bare.annotations),
            attributes=self._with_bare_attributes(bare, "").attributes,
        )

    def goes(self, name: str, value: Any, location: str) -> bool:
        """Whether a field is removed; it is listed if it reveals something."""
        if location.startswith("metadata.sceneloom."):
            kind = "location" if name in _OURS_REVEALING else None
        else:
            kind = "location" if location in _KEPT_TEXTS else kind_of(name, value)
        if kind in self.kinds:
            self.gone.append(skipped(f"reports-{kind}", location, f"a field that reports a {kind}: left out"))
        elif kind is not None:
            what = "a field that reports a date: stays; `--dates shift` leaves it out"
            self.left.append(assumed("reports-date", location, what))
        return kind in self.kinds

    def _with_bare_attributes(self, part: Any, prefix: str) -> Any:
        attributes = getattr(part, "attributes", ())
        kept = tuple(one for one in attributes if not self.goes(one.name, one.values, f"{prefix}attributes.{one.name}"))
        return replace(part, attributes=kept) if len(kept) < len(attributes) else part

    def _with_bare_frames(self, sensor: Any) -> Any:
        if isinstance(sensor, LidarSensor | RadarSensor | CameraSensor):
            return self._with_bare(sensor, "images" if isinstance(sensor, CameraSensor) else "frames")
        return sensor

    def _with_bare(self, sensor: Any, name: str) -> Any:
        frames: LazyFrames[Any] = getattr(sensor, name)
        if len(frames):
            # what the first one reports is listed for all
            without(frames[0].extras, f"sensors[{sensor.id}].{name}[].extras", self.goes)
        return replace(sensor, **{name: frames.mapped(partial(_bare_frame, self.kinds))})


def _bare_frame(kinds: frozenset[str], frame: Any) -> Any:
    extras = without(frame.extras, "", _RevealingFields(kinds).goes)
    return frame if extras is frame.extras else replace(frame, extras=extras)
