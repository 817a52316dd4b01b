"""Tracks as annotations that a labelling tool can take over.

Each object gets an `object` annotation, to which its cuboid and the detector's boxes in images belong; riders are
linked with what they ride. A cuboid has the fewest keyframes whose interpolation, as readers of `.sfs` do it, keeps
within tolerances; what is stationary has one, and holds at all times. What looks wrong is reported in the attribute
`review` and, the worst first, in the scene's metadata.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sceneloom.editing.record import skipped, with_ours, with_warnings
from sceneloom.errors import CalibrationError, PoseError
from sceneloom.scene.angles import CuboidAngles
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.boxes_2d import Box2DAnnotation
from sceneloom.scene.annotations.cuboids import CuboidAnnotation
from sceneloom.scene.annotations.relations import LinkAnnotation, ObjectAnnotation
from sceneloom.scene.annotations_frame import annotations_frame, not_in_world
from sceneloom.scene.clouds import RadarSensor
from sceneloom.scene.ego import EgoMotion
from sceneloom.scene.sample_positions import choose_ego
from sceneloom.scene.scene import Scene
from sceneloom.scene.tracks import Support, Track, Tracks
from sceneloom.scene.types import Coordinates
from sceneloom.scene.warnings import DataWarning
from sceneloom.tracking.labels.paths import LabelPath, boxed, boxed_part, label_path
from sceneloom.tracking.labels.pictured import boxes_in_images
from sceneloom.tracking.labels.quality import Flag, FlagKind, flag, flags_of, overlap_flags
from sceneloom.tracking.labels.radar import RadarEvidence, hear
from sceneloom.tracking.labels.reported import attributes_of
from sceneloom.tracking.labels.rider_association import riders
from sceneloom.tracking.labels.settings import LabelSettings
from sceneloom.version import __version__
from sceneloom.visibility.counted import with_activations, with_counts
from sceneloom.visibility.points import PointCounts, count_points
from sceneloom.visibility.projected import project_cuboids

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
    reported = attributes_of(track, settings.source, kinds)
    boxes: Sequence[Box2DAnnotation] = ()
    if settings.boxes_2d:
        gap_ns = round(settings.longest_gap * 1e9)
        boxes = list(
            boxes_in_images(scene, track, object_id(track), f"box-{track.id}", longest_gap_ns=gap_ns)
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
