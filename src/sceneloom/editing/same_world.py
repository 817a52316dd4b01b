"""Whether scenes are of one drive; and scenes in the world and the words of another one, before they are merged."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.editing.frame_change import FrameChange
from sceneloom.editing.moved_world import moved_world
from sceneloom.editing.record import assumed, ours_of, with_ours, with_warnings
from sceneloom.editing.sameness import is_same
from sceneloom.errors import CalibrationError, DataError, OptionError
from sceneloom.geometry.geodesy import ecef_from_geodetic
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.angles import CuboidAngles
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.cuboids import CuboidAnnotation, CuboidPath
from sceneloom.scene.annotations_frame import annotations_frame
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.motion import GnssSensor
from sceneloom.scene.scene import Scene
from sceneloom.scene.span import frame_times
from sceneloom.scene.types import Coordinates

WORLD_FROM_FILE = "world_from_file"
"""Our entry of the metadata with the transform that an earlier edit took off all locations in the world."""

_SAME_WORLD = 1e-9
"""Transforms that differ by no more are one [m], [rad]."""


def in_world_of(scene: Scene, first: Scene) -> Scene:
    """Give a scene in the world of another one, as far as their metadata report how the two are related.

    Raises:
        DataError: the metadata of one hold no rigid transform where they should.
    """
    mine, other = world_from_file(scene), world_from_file(first)
    if mine is None and other is None:
        return scene
    here = RigidTransform.identity() if mine is None else mine
    there = RigidTransform.identity() if other is None else other
    first_from_here = there.inverse() @ here
    reported = scene
    if mine is None or other is None:
        which = scene if mine is None else first
        what = "nothing says that its origin was moved; taken to be the world that the others were moved from"
        reported = with_warnings(scene, [assumed("worlds-related", which.source, what)])
    if np.abs(first_from_here.matrix - np.eye(4)).max() > _SAME_WORLD:
        reported = moved_world(reported, FrameChange.constant(first_from_here))
    entry = ours_of(first).get(WORLD_FROM_FILE)
    return with_ours(reported, **{WORLD_FROM_FILE: entry})


_CITY_WORDS = frozenset({"city", "city_name", "location", "map_name"})
"""Names of metadata that state where a drive was."""
_LONGEST_GAP_S = 3600.0
"""Parts of one drive are not further apart in time."""
_FASTEST = 100.0
"""No vehicle is faster [m/s]."""
_SAME_LOCATION = 100.0
"""How far apart fixes or poses of one ego may be at one time [m]: receivers and their antennas differ."""


def different_drives(first: Scene, second: Scene) -> list[str]:
    """Report why two scenes in one world are not of one drive; empty where nothing speaks against it."""
    reasons = []
    here, there = _cities(first.metadata), _cities(second.metadata)
    if here and there and here.isdisjoint(there):
        reasons.append(f"it was in {', '.join(sorted(there))}, the other in {', '.join(sorted(here))}")
    spans = _span_ns(first), _span_ns(second)
    if None not in spans:
        gap_s = (max(span[0] for span in spans if span) - min(span[1] for span in spans if span)) / 1e9
        if gap_s > _LONGEST_GAP_S:
            reasons.append(f"{_duration(gap_s)} are between them")
    apart = _apart(_fixes(first), _fixes(second))
    if apart is not None:
        reasons.append(f"their satellite fixes are {apart / 1000:,.1f} km apart")
    apart = _apart(_ego(first), _ego(second))
    if apart is not None:
        reasons.append(f"their egos are {apart:,.0f} m apart at one time")
    return reasons


def nothing_relates(first: Scene, second: Scene) -> bool:
    """Whether `different_drives` had nothing to compare but times, which of clocks that begin at 0 state nothing."""
    pairs = (
        (_cities(first.metadata), _cities(second.metadata)),
        (_fixes(first), _fixes(second)),
        (_ego(first), _ego(second)),
    )
    return not any(here and there for here, there in pairs)


def _cities(metadata: Mapping[str, Any], depth: int = 0) -> set[str]:
    """What metadata call the location, in words without case."""
    found: set[str] = set()
    for name, value in metadata.items():
        if isinstance(value, str) and value.strip() and name.lower() in _CITY_WORDS:
            found.add(value.strip().casefold())
        elif isinstance(value, Mapping) and depth < 3:
            found |= _cities(value, depth + 1)
    return found


def _span_ns(scene: Scene) -> tuple[int, int] | None:
    times = [timestamps for sensor in scene.sensors if len(timestamps := frame_times(sensor))]
    times += [
        trajectory.timestamps_ns
        for trajectory in scene.trajectories.values()
        if len(trajectory.timestamps_ns)
    ]
    if not times:
        return None
    return min(int(timestamps.min()) for timestamps in times), max(
        int(timestamps.max()) for timestamps in times
    )


def _duration(seconds: float) -> str:
    return f"{seconds / 3600:,.1f} h" if seconds < 172_800 else f"{seconds / 86_400:,.0f} days"


Track = tuple[Int64Array, Float64Array] | None
"""Times (N,) and locations (N, 3) [m]."""


def _fixes(scene: Scene) -> Track:
    """The fixes of the first receiver on the ellipsoid, earth-centred."""
    for sensor in scene.sensors:
        if isinstance(sensor, GnssSensor) and len(sensor.timestamps_ns):
            lla = sensor.positions_lla
            known = np.isfinite(lla).all(axis=1) & (np.abs(lla[:, 0]) <= 90) & (np.abs(lla[:, 2]) < 1e5)
            if known.any():
                return sensor.timestamps_ns[known], ecef_from_geodetic(lla[known])
    return None


def _ego(scene: Scene) -> Track:
    """The ego's trajectory, else that of the first sensor whose poses in the world are known, which is close to it."""
    found = [(trajectory.timestamps_ns, trajectory.positions) for trajectory in scene.trajectories.values()]
    for one in scene.sensors:
        if isinstance(one, LidarSensor | RadarSensor | CameraSensor) and one.coordinates is Coordinates.WORLD:
            path = one.poses
            found += [] if path is None or path.static else [(path.timestamps_ns, path.positions)]
    if not found or not len(found[0][0]) or not np.isfinite(found[0][1]).all():
        return None
    return found[0]


def _apart(first: Track, second: Track) -> float | None:
    """How far apart two ways are where an ego cannot be on both [m]; None where it can."""
    if first is None or second is None:
        return None
    (times, locations), (other_times, other_locations) = first, second
    inside = (other_times >= times[0]) & (other_times <= times[-1])
    if inside.any():
        with np.errstate(over="ignore", invalid="ignore"):
            at = other_times[inside]
            expected = np.column_stack([np.interp(at, times, locations[:, axis]) for axis in range(3)])
            apart = float(np.median(np.linalg.norm(other_locations[inside] - expected, axis=1)))
        return apart if apart > _SAME_LOCATION else None
    early, late = ((times, locations), (other_times, other_locations))
    if other_times[-1] < times[0]:
        early, late = late, early
    with np.errstate(over="ignore"):
        apart = float(np.linalg.norm(late[1][0] - early[1][-1]))
    gap_s = (int(late[0][0]) - int(early[0][-1])) / 1e9
    return apart if gap_s >= 0 and apart > _SAME_LOCATION + _FASTEST * gap_s else None


def world_from_file(scene: Scene) -> RigidTransform | None:
    """The transform that was taken off a scene's locations; None where none is named.

    Raises:
        DataError: what is named is no rigid transform.
    """
    named: Any = ours_of(scene).get(WORLD_FROM_FILE)
    if named is None:
        return None
    location = f"metadata.sceneloom.{WORLD_FROM_FILE}"
    try:
        matrix: Float64Array = np.array(named, np.float64)
        return RigidTransform.nearest(matrix)[0]
    except (TypeError, ValueError, CalibrationError):
        raise DataError(scene.source, location, f"{named!r}; expected a rigid 4x4 matrix") from None


def in_words_of(scene: Scene, first: Scene) -> Scene:
    """Give a scene whose cuboids have their angles in the unit and order of another one.

    Raises:
        OptionError: the annotations of one are in the world and those of the other on the ego.
    """
    frames = {annotations_frame(one) for one in (scene, first) if one.annotations}
    if len(frames) > 1:
        raise OptionError(
            f"{scene.source}: its annotations are in the {annotations_frame(scene)} frame, those of {first.source} in "
            f"the {annotations_frame(first)} frame; bring both into the world first: `sceneloom edit to-world`"
        )
    mine, theirs = CuboidAngles.of(scene), CuboidAngles.of(first)
    there = any(isinstance(annotation, CuboidAnnotation) for annotation in scene.annotations)
    if mine == theirs or not there:
        return scene
    annotations = tuple(_stated_otherwise(annotation, mine, theirs) for annotation in scene.annotations)
    changed = replace(scene, annotations=annotations)
    return with_ours(changed, euler_unit=str(theirs.unit), euler_order=theirs.order)


def _stated_otherwise(annotation: Annotation, mine: CuboidAngles, theirs: CuboidAngles) -> Annotation:
    if not isinstance(annotation, CuboidAnnotation):
        return annotation
    path = annotation.path
    return replace(
        annotation,
        path=CuboidPath(path.timestamps_ns, _rows(path.values, mine, theirs), path.extras),
        activations=tuple(
            entry if entry.cuboids is None else replace(entry, cuboids=_rows(entry.cuboids, mine, theirs))
            for entry in annotation.activations
        ),
        projections=tuple(
            entry if entry.cuboids is None else replace(entry, cuboids=_rows(entry.cuboids, mine, theirs))
            for entry in annotation.projections
        ),
    )


def _rows(rows: Float64Array, mine: CuboidAngles, theirs: CuboidAngles) -> Float64Array:
    stated = rows.copy()
    there = np.isfinite(rows[:, 6:]).all(axis=1)
    stated[there, 6:] = theirs.from_quaternions(mine.quaternions(rows[there, 6:]))
    return stated


def merged_metadata(first: Mapping[str, Any], second: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """The fields of both; of those that differ the first's. Gives the names of these, too."""
    differing = [name for name in first.keys() & second.keys() if not is_same(first[name], second[name])]
    return {**second, **first}, sorted(differing)
