"""A folder with a `rig.toml` as a scene."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from sceneloom.errors import CalibrationError, DataError, SceneloomError
from sceneloom.formats.default_poses import default_poses
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.rig.cameras import build_camera
from sceneloom.formats.rig.doubts import note_doubts
from sceneloom.formats.rig.drive import Drive, own_frame
from sceneloom.formats.rig.faults import Faults
from sceneloom.formats.rig.lidars import build_lidar
from sceneloom.formats.rig.manifest import Manifest, read_manifest
from sceneloom.formats.rig.motion_sensors import build_gnss, build_imu
from sceneloom.formats.rig.records import Record
from sceneloom.formats.rig.roots import open_root
from sceneloom.formats.rig.spec import MANIFEST, manifest_path
from sceneloom.formats.rig.trajectories import build_trajectory
from sceneloom.formats.rig.transforms import Edge, FrameTree, read_transform
from sceneloom.formats.rig.videos import VideoFile
from sceneloom.scene.assumed_camera_models import with_assumed_models
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.warnings import WarningKind

_BUILDERS: Mapping[str, Callable[[Drive, Record, str], Sensor]] = MappingProxyType(
    {"lidar": build_lidar, "camera": build_camera, "imu": build_imu, "gnss": build_gnss}
)

RESERVED_NAMES = {"gnss", "lidar", "identity"}
"""Names of trajectories that stand for ways which are computed."""


def open_rig(path: Path, *, lenient: bool = False, assume_model: bool = False) -> Scene:
    """Open a folder with a `rig.toml`, or a manifest itself; images and points are read when asked for.

    Args:
        path: the folder, or the manifest.
        lenient: leave out sensors and trajectories that are at fault, files without time and times without file.
        assume_model: allow computing with camera models whose formulas nothing confirms.

    Raises:
        DataError: the manifest, or what it names, is at fault; all faults are reported at once.
    """
    manifest = read_manifest(manifest_path(path))
    ledger = Ledger(lenient=lenient)
    try:
        with ledger.telling():
            scene = _open(manifest, ledger)
    except OSError as error:
        raise DataError(path, "", f"cannot be read: {error}") from error
    return with_assumed_models(scene) if assume_model else scene


def _open(manifest: Manifest, ledger: Ledger) -> Scene:
    faults = manifest.faults()
    tree = _frame_tree(manifest, faults, ledger)
    trajectories = _trajectories(manifest, tree, faults, ledger)
    drive = Drive(manifest, tree, default_poses(trajectories, str(manifest.path), ledger), ledger)
    closing = CloseVideos(drive.videos)
    sensors: list[Sensor] = []
    try:
        for location, record in manifest.records("sensors"):
            with _judging(location, faults, ledger):
                sensors.append(_BUILDERS[record["type"]](drive, record, location))
        faults.raise_all()
    except BaseException:
        closing()
        raise
    _note_frames_and_roots(drive)
    note_doubts(manifest.path, sensors, trajectories, ledger)
    return Scene(
        sensors=tuple(sensors),
        trajectories=MappingProxyType(trajectories),
        metadata=MappingProxyType({"rig": _about(manifest, tree)}),
        source=str(manifest.path.parent if manifest.path.name == MANIFEST else manifest.path),
        format="rig",
        warnings=ledger.warnings,
        on_close=closing,
    )


@dataclass(frozen=True, slots=True)
class CloseVideos:
    """Closes the videos of a scene."""

    videos: list[VideoFile]

    def __call__(self) -> None:
        """Close them all."""
        for video in self.videos:
            video.close()


@contextmanager
def _judging(location: str, faults: Faults, ledger: Ledger) -> Iterator[None]:
    """Note what goes wrong with one part; a lenient reading leaves the part out."""
    if not ledger.lenient:
        with faults.catching(location):
            yield
        return
    try:
        yield
    except SceneloomError as error:
        where, problem = location, str(error)
        if isinstance(error, DataError) and error.file == str(faults.file) and error.location:
            where, problem = error.location, error.problem
        message = f"left out: {problem}"
        ledger.note(WarningKind.SKIPPED, "parts-at-fault", f"{faults.file}: {where}", message)


def _frame_tree(manifest: Manifest, faults: Faults, ledger: Ledger) -> FrameTree:
    """Read all transforms; without a sound tree nothing else can be judged.

    Raises:
        DataError: naming all transforms that are at fault.
    """
    edges = []
    tables = [
        (location, record, record["from"], record["to"])
        for location, record in manifest.records("transforms")
    ]
    for location, sensor in manifest.records("sensors"):
        if "extrinsic" not in sensor:
            continue
        where, record, frame = f"{location}.extrinsic", sensor["extrinsic"], own_frame(sensor)
        if ("to" in record) == ("from" in record):
            found = "to and from" if "to" in record else "neither to nor from"
            faults.add(where, f"{found}; expected `to`: the frame that points of {frame!r} are taken into")
            continue
        tables.append((where, record, record.get("from", frame), record.get("to", frame)))
    for location, record, source, target in tables:
        with faults.catching(location):
            where = f"{manifest.path}: {location}"
            edges.append(Edge(source, target, read_transform(record, where, ledger), location))
    faults.raise_all()
    try:
        return FrameTree(manifest.ego, edges)
    except CalibrationError as error:
        raise DataError(manifest.path, "", str(error)) from None


def _trajectories(
    manifest: Manifest, tree: FrameTree, faults: Faults, ledger: Ledger
) -> dict[str, Trajectory]:
    trajectories = {}
    for location, record in manifest.records("trajectories"):
        name = record.get("name", "pose")
        if name in RESERVED_NAMES:
            faults.add(
                f"{location}.name",
                f"{name!r} stands for a trajectory that is computed; expected another name",
            )
        elif name in trajectories:
            faults.add(f"{location}.name", f"a second trajectory {name!r}; expected different names")
        else:
            with _judging(location, faults, ledger):
                trajectories[name] = build_trajectory(manifest, record, location, tree, ledger)
    return trajectories


def _note_frames_and_roots(drive: Drive) -> None:
    path = drive.manifest.path
    if drive.tree.loose:
        message = f"frames {', '.join(map(repr, drive.tree.loose))} are not connected with {drive.tree.ego!r}; not used"
        drive.ledger.note(WarningKind.SKIPPED, "loose-frames", str(path), message)
    records = [drive.manifest.record, *(record for _, record in drive.manifest.records("sensors"))]
    for name in dict.fromkeys(record["root"] for record in records if "root" in record):
        root = open_root(path, [name], "root").folder
        if not root.is_relative_to(path.parent.resolve()):
            message = f"files are read from {root}, outside the manifest's folder"
            drive.ledger.note(WarningKind.ASSUMED, "root-elsewhere", str(path), message)


def _about(manifest: Manifest, tree: FrameTree) -> dict[str, Any]:
    """What the manifest says that the model has no other location for: its name, and `ego_from_frame` of all frames."""
    frames = {
        name: [*tree.ego_from(name).translation.tolist(), *tree.ego_from(name).quaternion_xyzw.tolist()]
        for name in tree.frames
        if name not in tree.loose
    }
    about: dict[str, Any] = {"ego": manifest.ego, "ego_from_frame": frames}
    return {**about, "name": manifest.record["name"]} if "name" in manifest.record else about
