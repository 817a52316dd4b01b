"""Annotations made from tracks: cuboids, image boxes, attributes and rider links.

Each object gets an `object` annotation, to which its cuboid and the detector's boxes in images belong; riders are
linked with what they ride. A cuboid has the fewest keyframes whose interpolation, as readers of `.sfs` do it, keeps
within tolerances; what is stationary has one, and holds at all times. What looks wrong is reported in the attribute
`review` and, the worst first, in the scene's metadata.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.colouring.cuboid_points import PointCounts, count_points, with_activations, with_counts
from sceneloom.colouring.cuboid_projection import project_cuboids
from sceneloom.detections.detectors import kind_name
from sceneloom.editing.references import skipped, with_ours, with_warnings
from sceneloom.errors import CalibrationError, PoseError
from sceneloom.scene.annotations import (
    Annotation,
    AttributePath,
    Box2DAnnotation,
    BoxPath,
    CuboidAnnotation,
    LinkAnnotation,
    ObjectAnnotation,
)
from sceneloom.scene.annotations_at import CuboidAngles, annotations_frame, not_in_world
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import RadarSensor
from sceneloom.scene.detections import Support, Track, Tracks
from sceneloom.scene.ego import EgoMotion
from sceneloom.scene.sampling import choose_ego
from sceneloom.scene.scene import Scene, usual_period_ns
from sceneloom.scene.types import Coordinates, Identifier, Key, key_of
from sceneloom.tracking.label_paths import (
    Flag,
    FlagKind,
    LabelPath,
    RadarEvidence,
    boxed,
    boxed_part,
    flag,
    flags_of,
    hear,
    label_path,
    overlap_flags,
)
from sceneloom.tracking.settings import LabelSettings
from sceneloom.version import __version__
from sceneloom.warnings import DataWarning

_EXISTENCE, _SUPPORT, _SPEED, _POSITION_SIGMA = "existence", "support", "speed", "position_sigma"
"""Names of the attributes that hold over time: probability, a word of `Support`, [m/s], [m]."""

_TRACK, _SOURCE, _REVIEW = "track", "source", "review"
"""Names of those that hold at all times: number of the track, where it comes from, what to look at first."""

_STEPS = {_EXISTENCE: 0.05, _SPEED: 0.5, _POSITION_SIGMA: 0.1}
"""A value holds until the true one is so far from it."""

_DECIMALS = 3


def _attributes_of(track: Track, source: str, flags: Sequence[str]) -> tuple[AttributePath, ...]:
    """Report of an object what its track knows; what holds over time is reported only where it changes."""
    times, covariances = track.timestamps_ns, track.covariances
    level = np.trace(covariances[:, :2, :2], axis1=1, axis2=2) / 2.0
    numbers = {
        _EXISTENCE: track.scores,
        _SPEED: np.linalg.norm(track.velocities[:, :2], axis=1),
        _POSITION_SIGMA: np.sqrt(np.maximum(level, 0.0)),
    }
    timed = [_stepped(name, times, values, _STEPS[name]) for name, values in numbers.items()]
    words = [Support(k).name.lower() for k in track.supports.tolist()]
    changes = [k for k, word in enumerate(words) if k == 0 or words[k - 1] != word]
    timed.append(AttributePath(_SUPPORT, tuple(words[k] for k in changes), times[changes]))
    still: dict[str, Any] = {_TRACK: track.id, _SOURCE: source}
    if flags:
        still[_REVIEW] = tuple(flags)
    return (*timed, *(_static(name, value, int(times[0])) for name, value in still.items()))


def _static(name: str, value: Any, time_ns: int) -> AttributePath:
    """An attribute that holds at all times; its only timestamp is for readers that want one."""
    return AttributePath(name, (value,), np.array([time_ns], np.int64), static=True)


def _stepped(name: str, times_ns: Int64Array, values: Float64Array, step: float) -> AttributePath:
    kept: list[int] = []
    for k, value in enumerate(values.tolist()):
        if not kept or abs(value - values[kept[-1]]) >= step:
            kept.append(k)
    return AttributePath(name, tuple(round(float(values[k]), _DECIMALS) for k in kept), times_ns[kept])


_RIDDEN = frozenset(
    {"bicycle", "bike", "motorcycle", "motorbike", "scooter", "moped", "cyclist", "motorcyclist"}
)

_NEAR = 0.8
"""A rider's middle is no farther than this from that of what he rides, seen from above [m]."""

_LEAST_STATES = 3

_SHARE = 0.7
"""Of the time that both are there, so much they are together."""


def _plain(label: str) -> str:
    return "".join(letter for letter in label.casefold() if letter.isalnum())


def _is_person(label: str) -> bool:
    return _plain(label) == "rider" or (kind_name(label) == "pedestrian" and _plain(label) not in _RIDDEN)


def riders(tracks: Iterable[Track]) -> Iterator[tuple[Track, Track]]:
    """Give each rider with what he rides; each of both once, the nearest pairs first.

    Words for a rider and what he rides together, such as "cyclist", count as what is ridden: a detector that says so
    has one box for both, and a person beside it is somebody who is there, too.
    """
    kept = list(tracks)
    people = [track for track in kept if _is_person(track.label)]
    ridden = [track for track in kept if _plain(track.label) in _RIDDEN]
    pairs = [
        (distance, person, bike)
        for person in people
        for bike in ridden
        if (distance := _together(person, bike)) is not None
    ]
    taken: set[int] = set()
    for _, person, bike in sorted(pairs, key=lambda pair: (pair[0], pair[1].id, pair[2].id)):
        if not {person.id, bike.id} & taken:
            taken |= {person.id, bike.id}
            yield person, bike


def _together(person: Track, bike: Track) -> float | None:
    """How near two usually are [m]; None if they are not together."""
    _, mine, its = np.intersect1d(person.timestamps_ns, bike.timestamps_ns, return_indices=True)
    if len(mine) < _LEAST_STATES:
        return None
    apart = np.linalg.norm(person.centers[mine, :2] - bike.centers[its, :2], axis=1)
    return float(np.median(apart)) if float((apart < _NEAR).mean()) >= _SHARE else None


_PICTURED_DECIMALS = 2
"""Of pixels that are written."""


def _boxes_in_images(
    scene: Scene, track: Track, parent_id: Identifier, stem: str, *, longest_gap_ns: int
) -> Iterator[Box2DAnnotation]:
    """Give the boxes that the detector found of an object in images, by camera, at the times of these images.

    Args:
        scene: whose cameras have the images. Of a camera without images the times are those of the track.
        track: with boxes in images.
        parent_id: of the object.
        stem: how ids begin.
        longest_gap_ns: after a longer time without a box another annotation begins [ns].
    """
    cameras: dict[Key, CameraSensor] = {key_of(camera.id): camera for camera in scene.cameras}
    for camera_id, corners in track.corners_xyxy.items():
        rows = np.flatnonzero(
            np.isfinite(corners).all(axis=1) & (corners[:, 2:] > corners[:, :2]).all(axis=1)
        )
        if len(rows) == 0 or key_of(camera_id) not in cameras:
            continue
        times, chosen = _at_images(cameras[key_of(camera_id)], track.timestamps_ns[rows])
        breaks = np.flatnonzero(np.diff(times) > longest_gap_ns) + 1
        for part, own in enumerate(np.split(np.arange(len(times)), breaks)):
            tail = f"-{part + 1}" if len(breaks) else ""
            yield Box2DAnnotation(
                f"{stem}-{camera_id}{tail}",
                camera_id,
                BoxPath(times[own], _left_top_width_height(corners[rows[chosen[own]]])),
                label=track.label,
                parent_id=parent_id,
            )


def _left_top_width_height(corners_xyxy: Float64Array) -> Float64Array:
    rounded = np.round(corners_xyxy, _PICTURED_DECIMALS)
    return np.column_stack([rounded[:, :2], rounded[:, 2:] - rounded[:, :2]])


def _at_images(camera: CameraSensor, times_ns: Int64Array) -> tuple[Int64Array, Int64Array]:
    """The times of the images nearest to some times, each once, and which of these they are nearest to."""
    timestamps = camera.images.timestamps_ns
    if len(timestamps) == 0:
        return times_ns, np.arange(len(times_ns))
    after = np.clip(np.searchsorted(timestamps, times_ns), 1, max(len(timestamps) - 1, 1))
    after = np.minimum(after, len(timestamps) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(times_ns - timestamps[before] <= timestamps[after] - times_ns, before, after)
    away = np.abs(timestamps[nearest] - times_ns)
    near = np.flatnonzero(away <= max(usual_period_ns(timestamps), 1))
    found, first = np.unique(timestamps[nearest[near]], return_index=True)
    return found, near[first]


DEFAULTS = LabelSettings()

LABELS = "labels"
"""Name of our entry in a scene's metadata that says how labels were made and what to look at first."""

_NO_EVIDENCE = RadarEvidence({}, ())


@dataclass(frozen=True, slots=True, eq=False)
class Labelled:
    """A scene with labels.

    Attributes:
        scene: with annotations of the objects behind those that it had.
        flags: what a person should look at, the most urgent first.
        objects: how many objects are labelled.
        stationary: how many of them are stationary.
        states: how many states their tracks have.
        keyframes: how many keyframes report them.
    """

    scene: Scene
    flags: tuple[Flag, ...]
    objects: int
    stationary: int
    states: int
    keyframes: int


def label_tracks(
    scene: Scene,
    tracks: Tracks,
    *,
    settings: LabelSettings = DEFAULTS,
    trajectory: str | EgoMotion | None = None,
) -> Labelled:
    """Rotate tracks into annotations of a scene, with what its sensors state of them.

    What a scene lacks is left out with a warning: projections without known locations of cameras, points without those
        of
    lidars, speeds without those of radars.

    Args:
        scene: whose world the tracks are in; one without sensors is enough.
        tracks: the objects.
        settings: how labels are made.
        trajectory: name of the ego trajectory, as for `Scene.samples`.

    Raises:
        OptionError: there is no such trajectory, the scene's annotations are in the ego's frame, or one of them has the
            id of a label.
        DataError: a sensor's frame cannot be read.
    """
    if scene.annotations and annotations_frame(scene) is not Coordinates.WORLD:
        raise not_in_world(scene.source)
    kept = [part for track in tracks if (part := boxed_part(track)) and _is_wanted(part, settings)]
    ego, warnings = choose_ego(scene, trajectory), list[DataWarning]()
    pairs = list(riders(kept)) if settings.links else []
    paths = [label_path(track, settings) for track in kept]
    cuboids = [_cuboid(track, path, scene, settings) for track, path in zip(kept, paths, strict=True)]
    seen, counts = _seen_by_sensors(replace(scene, annotations=tuple(cuboids)), settings, ego, warnings)
    heard = _heard(scene, kept, settings, ego, warnings)
    together = {frozenset((person.id, bike.id)) for person, bike in pairs}
    flags = [one for track in kept for one in flags_of(track)]
    flags += [*overlap_flags(kept, together), *heard.flags, *_empty(kept, counts)]
    flags.sort(key=lambda one: (-one.urgency, one.track, one.kind))
    made: list[Annotation] = []
    for track, cuboid in zip(kept, seen, strict=True):
        made += _annotations(scene, track, cuboid, heard, flags, settings)
    made += [_link(person, bike) for person, bike in pairs]
    labelled = replace(scene, annotations=(*scene.annotations, *made))
    labelled = with_ours(labelled, **{**_angles(scene), LABELS: _record(flags, settings, len(kept))})
    keyframes = sum(len(cuboid.path.timestamps_ns) for cuboid in cuboids)
    return Labelled(
        with_warnings(labelled, warnings),
        tuple(flags),
        len(kept),
        sum(path.stands for path in paths),
        sum(len(track) for track in kept),
        keyframes,
    )


def _is_wanted(track: Track, settings: LabelSettings) -> bool:
    enough = int(boxed(track).sum()) >= settings.least_states
    return enough and float(track.scores.max()) >= settings.least_score


def object_id(track: Track) -> str:
    """The id of the annotation of a track's object."""
    return f"object-{track.id}"


def cuboid_id(track: Track) -> str:
    """The id of the cuboid of a track's object."""
    return f"cuboid-{track.id}"


def _cuboid(track: Track, path: LabelPath, scene: Scene, settings: LabelSettings) -> CuboidAnnotation:
    return CuboidAnnotation(
        cuboid_id(track),
        path.cuboids(path.keyframes(settings), CuboidAngles.of(scene)),
        label=track.label,
        stationary=path.stands,
        parent_id=object_id(track),
    )


def _annotations(
    scene: Scene,
    track: Track,
    cuboid: CuboidAnnotation,
    heard: RadarEvidence,
    flags: Iterable[Flag],
    settings: LabelSettings,
) -> list[Annotation]:
    """The object of a track, and what belongs to it."""
    kinds = [str(one.kind) for one in flags if one.track == track.id]
    reported = _attributes_of(track, settings.source, kinds)
    boxes: Sequence[Box2DAnnotation] = ()
    if settings.boxes_2d:
        gap_ns = round(settings.longest_gap * 1e9)
        boxes = list(
            _boxes_in_images(scene, track, object_id(track), f"box-{track.id}", longest_gap_ns=gap_ns)
        )
    about = heard.attributes.get(track.id, ())
    whole = replace(cuboid, attributes=(*reported, *about, *cuboid.attributes))
    return [ObjectAnnotation(object_id(track), label=track.label), whole, *boxes]


def _link(person: Track, bike: Track) -> LinkAnnotation:
    ids = cuboid_id(person), cuboid_id(bike)
    return LinkAnnotation(f"link-{person.id}-{bike.id}", *ids, label="rides", is_bidirectional=False)


def _seen_by_sensors(
    scene: Scene, settings: LabelSettings, ego: EgoMotion | None, warnings: list[DataWarning]
) -> tuple[list[CuboidAnnotation], PointCounts | None]:
    """The cuboids of a scene with what its cameras and lidars state of them, and the points in them."""
    counts = None
    if settings.projections and any(len(camera.images) for camera in scene.cameras):
        try:
            known = len(scene.warnings)
            scene = project_cuboids(scene, trajectory=ego, activations=True)
            warnings += scene.warnings[known:]
        except (PoseError, CalibrationError) as error:
            warnings.append(
                skipped("labels-not-projected", "annotations", f"cuboids are in no image: {error}")
            )
    if settings.points and scene.lidars:
        try:
            counts = count_points(scene, moment="points", trajectory=ego, activations=False)
            scene = with_activations(with_counts(scene, counts), counts)
        except PoseError as error:
            warnings.append(skipped("labels-not-counted", "annotations", f"points were not counted: {error}"))
    return [each for each in scene.annotations if isinstance(each, CuboidAnnotation)], counts


def _heard(
    scene: Scene,
    tracks: Sequence[Track],
    settings: LabelSettings,
    ego: EgoMotion | None,
    warnings: list[DataWarning],
) -> RadarEvidence:
    if not settings.radar or not any(isinstance(sensor, RadarSensor) for sensor in scene.sensors):
        return _NO_EVIDENCE
    try:
        return hear(scene, tracks, ego)
    except PoseError as error:
        warnings.append(skipped("labels-not-heard", "annotations", f"radars were not asked: {error}"))
        return _NO_EVIDENCE


def _empty(tracks: Sequence[Track], counts: PointCounts | None) -> list[Flag]:
    """Flag objects without points in sweeps that have a box of them."""
    if counts is None:
        return []
    found: list[Flag] = []
    for number, track in enumerate(tracks):
        rows = np.flatnonzero(np.isin(track.supports, (Support.BOTH, Support.SWEEP)))
        points, known = np.zeros(len(rows), np.int64), np.zeros(len(rows), np.bool_)
        for lidar in counts.lidars:
            if not len(lidar.timestamps_ns):
                continue
            frames = np.searchsorted(lidar.timestamps_ns, track.timestamps_ns[rows], side="right") - 1
            there = (frames >= 0) & lidar.there[frames, number]
            points += np.where(there, lidar.counts[frames, number], 0)
            known |= there
        rows, points = rows[known], points[known]
        if len(rows):
            found += flag(track, FlagKind.EMPTY, float((points == 0).mean()), int(rows[points.argmin()]))
    return found


def _angles(scene: Scene) -> dict[str, Any]:
    angles = CuboidAngles.of(scene)
    return {"euler_unit": str(angles.unit), "euler_order": str(angles.order)}


def _record(flags: Sequence[Flag], settings: LabelSettings, objects: int) -> dict[str, Any]:
    """How labels were made and what to look at first, for the scene's metadata."""
    return {
        "made_by": f"sceneloom {__version__}",
        "source": settings.source,
        "objects": objects,
        "tolerance_m": settings.tolerance_m,
        "tolerance_deg": settings.tolerance_deg,
        "constant_sizes": settings.constant_sizes,
        "review": [
            {
                "annotation": f"cuboid-{one.track}",
                "flag": str(one.kind),
                "timestamp_ns": one.timestamp_ns,
                "value": one.value,
                "urgency": round(one.urgency, 2),
            }
            for one in flags
        ],
    }
