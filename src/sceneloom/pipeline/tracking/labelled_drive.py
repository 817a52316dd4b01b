"""A scene whose labels lie where its drive was tracked: along the ego trajectory that was followed."""

from dataclasses import replace
from types import MappingProxyType

from sceneloom.pipeline.detections.detected import DetectedDrive
from sceneloom.scene.ego import EgoMotion
from sceneloom.scene.poses import Poses, Trajectory, same_direction
from sceneloom.scene.scene import Scene
from sceneloom.scene.sensor_sources import needs_ego
from sceneloom.scene.tracks import Tracks
from sceneloom.tracking.labels.making import Labelled, label_tracks

FOLLOWED = "tracking"
"""Name of a ego trajectory that the scene does not have itself, but tracking went by."""


def label_drive(scene: Scene, drive: DetectedDrive, tracks: Tracks) -> Labelled:
    """Put the tracks of a drive into its scene.

    The trajectory that tracking went by becomes the scene's default one: one of its own, or the one that was found from
    sweeps or satellites. So the labels are in the world of the file that is written.

    Args:
        scene: the drive's.
        drive: as it was tracked.
        tracks: in its world.

    Raises:
        OptionError: the scene's annotations are in the ego's frame, or have the ids of labels.
        DataError: a sensor's frame cannot be read.
    """
    if not needs_ego(scene) or drive.source.own:
        return label_tracks(scene, tracks)
    ego = EgoMotion(FOLLOWED, drive.source.path)
    return label_tracks(_following(scene, ego.path), tracks, trajectory=ego)


def _following(scene: Scene, path: Poses) -> Scene:
    """The scene with this ego trajectory as its default one; an ego that is stationary has none."""
    if path.static:
        return scene
    known = next(
        (name for name, trajectory in scene.trajectories.items() if same_direction(trajectory, path)), None
    )
    followed = Trajectory(FOLLOWED, path.timestamps_ns, path.positions, path.quaternions_xyzw)
    first = {FOLLOWED: followed} if known is None else {known: scene.trajectories[known]}
    return replace(scene, trajectories=MappingProxyType({**first, **scene.trajectories}))
