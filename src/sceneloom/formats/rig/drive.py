"""What the sensors of a manifest are built with."""

from dataclasses import dataclass, field

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.rig.manifest import Manifest
from sceneloom.formats.rig.records import Record
from sceneloom.formats.rig.roots import Root, open_root
from sceneloom.formats.rig.times import TimeSource
from sceneloom.formats.rig.transforms import FrameTree
from sceneloom.formats.rig.videos import VideoFile
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.pose_source import poses_along
from sceneloom.scene.poses import Poses


def own_frame(record: Record) -> str:
    """The name of a sensor's own frame."""
    return str(record["frame"] if "frame" in record else record["id"])


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """A manifest while its scene is made.

    Attributes:
        manifest: the records.
        tree: the frames.
        ego_path: `world_from_ego` of the default trajectory, or None.
        ledger: takes warnings, and faults in a lenient reading.
        videos: those that were opened; the scene closes them.
    """

    manifest: Manifest
    tree: FrameTree
    ego_path: Poses | None
    ledger: Ledger
    videos: list[VideoFile] = field(default_factory=list)

    def root(self, record: Record, location: str) -> Root:
        """The folder of a sensor's files.

        Raises:
            DataError: there is no such folder.
        """
        return open_root(
            self.manifest.path, [record.get("root"), self.manifest.record.get("root")], f"{location}.root"
        )

    def time_source(self, record: Record, location: str) -> TimeSource:
        """What the timestamps of a sensor are read with."""
        root = self.root(record, location)
        offset_ns = int(record.get("time_offset_s", 0))
        return TimeSource(
            record.get("times", {}), f"{location}.times", self.manifest.path, root, offset_ns, self.ledger
        )

    def mount(self, record: Record) -> RigidTransform:
        """`ego_from_frame` of a sensor's own frame.

        Raises:
            CalibrationError: no transforms lead there.
        """
        return self.tree.ego_from(own_frame(record))

    def poses(self, mount: RigidTransform, timestamps_ns: Int64Array) -> Poses | None:
        """`world_from_sensor` at those of the times that the default trajectory covers."""
        return poses_along(self.ego_path, {0: mount}, np.zeros(len(timestamps_ns), np.int64), timestamps_ns)
