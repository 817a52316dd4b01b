"""The sensors of one session as fusion systems, one for each lidar, fed in the order of what came."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np

from sceneloom.colouring.results import FusedFrame
from sceneloom.fusion.calibration.axes import SensorKind
from sceneloom.fusion.counters import Counters
from sceneloom.fusion.declared_data import standard_boxes, standard_frame
from sceneloom.fusion.detection_fusion import FusedDetectionFrame, SeenBoxes
from sceneloom.fusion.messages.boxes import Boxes2d, Boxes3d
from sceneloom.fusion.messages.records import ResultRecord
from sceneloom.fusion.messages.scene_form import boxes_2d_of, boxes_3d_of
from sceneloom.fusion.outgoing import fused_detections_record, sensor_fusion_record
from sceneloom.fusion.sensors import STILL
from sceneloom.fusion.setting import Setting
from sceneloom.fusion.system import FusionSystem
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import LidarFrame, Picture
from sceneloom.scene.pose_source import PoseSource
from sceneloom.scene.poses import PosePath

_REACH_NS = 200_000_000
"""How far beyond the last pose the way of the vehicle is continued: poses come later than what they are for."""

Received = LidarFrame | Picture | Boxes3d | Boxes2d


@dataclass(frozen=True, slots=True, eq=False)
class RigResult:
    """One result, and the configuration in force when its sweep came.

    Attributes:
        record: of table 9 or 10.
        setting: the configuration.
    """

    record: ResultRecord
    setting: Setting


@dataclass(slots=True)
class Rig:
    """What a session's worker feeds: not for several threads at once.

    Each lidar has a fusion system of its own, whose ego frame is the lidar's: calibrations are of pairs, and those of
    two lidars need not agree on where a camera is. A picture goes to all that its camera is calibrated with.

    Attributes:
        counters: where what is left out is counted.
    """

    counters: Counters
    _setting: Setting | None = None
    _systems: dict[int, FusionSystem] = field(default_factory=dict)
    _cameras: set[tuple[int, int]] = field(default_factory=set)
    _path: PosePath | None = None
    _sent: dict[tuple[str, int, int], tuple[int, Setting, Boxes3d | Boxes2d | None]] = field(
        default_factory=dict
    )

    def feed(self, sensor_id: int, received: Received, seq: int, setting: Setting) -> Iterator[RigResult]:
        """Take what a sensor sent, and give what could be fused with it."""
        self._adopt(setting)
        for lidar_id in self._lidars_of(sensor_id, received):
            system = self._systems[lidar_id]
            self._send(system, lidar_id, sensor_id, received, seq, setting)
            yield from self._fetch(lidar_id, system)

    def flush(self) -> Iterator[RigResult]:
        """Fuse all that waits with what has come."""
        for lidar_id, system in self._systems.items():
            system.flush()
            yield from self._fetch(lidar_id, system)

    @property
    def waits(self) -> bool:
        """Whether a sweep or its boxes wait for a picture."""
        return any(system.waits for system in self._systems.values())

    def move(self, path: PosePath) -> None:
        """Let the vehicle move along a way from now on."""
        self._path = path
        for system in self._systems.values():
            self._place(system)

    def _lidars_of(self, sensor_id: int, received: Received) -> list[int]:
        """The lidars whose fusion systems something goes to."""
        if isinstance(received, LidarFrame | Boxes3d):
            return [sensor_id] if sensor_id in self._systems else []
        return sorted(lidar_id for camera_id, lidar_id in self._cameras if camera_id == sensor_id)

    def _send(
        self,
        system: FusionSystem,
        lidar_id: int,
        sensor_id: int,
        received: Received,
        seq: int,
        setting: Setting,
    ) -> None:
        axes = setting.frames.lidar.standard_from_declared(SensorKind.LIDAR)
        before = system.dropped
        if isinstance(received, LidarFrame):
            extras = MappingProxyType({**received.extras, "setting": setting})
            system.send(f"lidar{sensor_id}", replace(standard_frame(received, axes), extras=extras))
        elif isinstance(received, Boxes3d):
            self._remember("boxes_3d", sensor_id, received.timestamp.nanoseconds, seq, setting, received)
            boxes = boxes_3d_of(standard_boxes(received, axes), sensor_id=f"lidar{sensor_id}")
            system.send(f"lidar{sensor_id}", boxes)
        else:
            pair = setting.pairs.get((sensor_id, lidar_id))
            if pair is None:
                return
            mount = pair.camera_from_lidar.inverse()
            if isinstance(received, Picture):
                self._remember("image", sensor_id, received.timestamp_ns, seq, setting, None)
                picture = replace(received, camera=pair.camera, mount=mount)
                system.send(f"camera{sensor_id}", picture)
            else:
                self._remember("boxes_2d", sensor_id, received.timestamp.nanoseconds, seq, setting, received)
                seen = SeenBoxes(boxes_2d_of(received, sensor_id=f"camera{sensor_id}"), pair.camera, mount)
                system.send(f"camera{sensor_id}", seen)
        self.counters.add("dropped.waiting", system.dropped - before)

    def _fetch(self, lidar_id: int, system: FusionSystem) -> Iterator[RigResult]:
        for fused in iter(system.get, None):
            yield from self._sensor_data(lidar_id, fused)
        for found in iter(system.get_detections, None):
            yield self._detections(lidar_id, found)

    def _sensor_data(self, lidar_id: int, fused: FusedFrame) -> Iterator[RigResult]:
        setting: Setting = fused.extras["setting"]
        self.counters.add("unpaired.points", not fused.views)
        compensated = self._compensates(setting) and not fused.standing
        world_from_lidar = self._world_from_lidar(fused.reference_ns) if compensated else _HERE
        for view in fused.views:
            camera_id = int(str(view.camera_id).removeprefix("camera"))
            image_seq, _, _ = self._sent["image", camera_id, view.timestamp_ns]
            record = sensor_fusion_record(
                fused,
                view,
                world_from_lidar,
                setting,
                camera_id=camera_id,
                lidar_id=lidar_id,
                image_seq=image_seq,
                points_seq=fused.extras["seq"],
                motion_compensated=compensated,
            )
            yield RigResult(record, setting)

    def _detections(self, lidar_id: int, found: FusedDetectionFrame) -> RigResult:
        _, setting, boxes_3d = self._sent["boxes_3d", lidar_id, found.timestamp_ns]
        camera_id = int(str(found.camera_id).removeprefix("camera"))
        _, _, boxes_2d = self._sent["boxes_2d", camera_id, found.picture_timestamp_ns]
        if not isinstance(boxes_3d, Boxes3d) or not isinstance(boxes_2d, Boxes2d):
            raise TypeError("boxes were remembered as something else")
        compensated = self._compensates(setting) and not found.standing
        record = fused_detections_record(found, boxes_3d, boxes_2d, setting, motion_compensated=compensated)
        return RigResult(record, setting)

    def _adopt(self, setting: Setting) -> None:
        """Go by another configuration from this record on."""
        if setting is self._setting:
            return
        self._setting = setting
        for camera_id, lidar_id in setting.pairs:
            if lidar_id not in self._systems:
                system = FusionSystem(setting.configuration)
                system.add_lidar(
                    f"lidar{lidar_id}", _AT_LIDAR, period_ns=setting.sweep_period_ns, place=_AT_LIDAR
                )
                self._systems[lidar_id] = system
            if (camera_id, lidar_id) not in self._cameras:
                self._systems[lidar_id].add_camera(f"camera{camera_id}", _AT_LIDAR, index=camera_id % 255)
                self._cameras.add((camera_id, lidar_id))
        for system in self._systems.values():
            system.configure(setting.configuration, period_ns=setting.sweep_period_ns)
            self._place(system)

    def _place(self, system: FusionSystem) -> None:
        if self._path is not None and self._setting is not None and self._compensates(self._setting):
            system.move(self._path, reach_ns=_REACH_NS)
        else:
            system.move(STILL)

    def _compensates(self, setting: Setting) -> bool:
        return self._path is not None and setting.properties["motion_compensation"] == 1

    def _world_from_lidar(self, time_ns: int) -> RigidTransform:
        if self._path is None:
            return _HERE
        pose = PoseSource(self._path, _HERE, _REACH_NS).at(np.array([time_ns], np.int64))
        return RigidTransform.from_quaternion(pose.positions[0], pose.quaternions_xyzw[0])

    def _remember(
        self,
        kind: str,
        sensor_id: int,
        time_ns: int,
        seq: int,
        setting: Setting,
        boxes: Boxes3d | Boxes2d | None,
    ) -> None:
        """Keep what a result has to say of a record, by the time that the result names; the oldest are forgotten."""
        self._sent[kind, sensor_id, time_ns] = seq, setting, boxes
        most = 4 * setting.properties["queue_length"] * max(len(self._cameras), 1) + 64
        while len(self._sent) > most:
            self._sent.pop(next(iter(self._sent)))


_HERE = RigidTransform.identity()
_AT_LIDAR = PoseSource(STILL, _HERE)
