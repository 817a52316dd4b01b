"""The sensors of one session as fusion systems, one for each lidar, fed in the order of what came."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, NamedTuple, cast

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.colouring.results import FusedFrame
from sceneloom.errors import DataError
from sceneloom.fusion.accepted import CLOCK_JUMP_NS, Accepted, Received, WholeRecord
from sceneloom.fusion.calibration.axes import SensorKind
from sceneloom.fusion.counters import Counters
from sceneloom.fusion.declared_data import standard_boxes, standard_frame
from sceneloom.fusion.detection_fusion import FusedDetectionFrame, SeenBoxes
from sceneloom.fusion.found_objects import FoundObjects
from sceneloom.fusion.ledger import Ledger, Stream, Ticket
from sceneloom.fusion.messages.boxes import Boxes3d
from sceneloom.fusion.messages.records import ResultRecord
from sceneloom.fusion.messages.scene_form.boxes import boxes_2d_of, boxes_3d_of
from sceneloom.fusion.messages.scene_form.images import image_of_raw
from sceneloom.fusion.messages.sensor_data import ImageData, RawData
from sceneloom.fusion.mounting import trajectory_of_mounted
from sceneloom.fusion.outgoing import fused_detections_record, sensor_fusion_record
from sceneloom.fusion.pairing import Leave
from sceneloom.fusion.sensors import STILL
from sceneloom.fusion.setting import Setting
from sceneloom.fusion.system import FusionSystem
from sceneloom.geometry.interpolation import OUT_OF_REACH
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraImage
from sceneloom.scene.clouds import LidarFrame
from sceneloom.scene.pose_source import PoseSource
from sceneloom.scene.poses import Poses
from sceneloom.scene.shutter import GLOBAL

REACH_NS = 200_000_000
"""How far beyond the last pose the ego trajectory is continued: poses come later than what they are for."""


@dataclass(frozen=True, slots=True, eq=False)
class RigResult:
    """One result, and the configuration in force when its sweep came.

    Attributes:
        record: of table 9 or 10.
        setting: the configuration.
        found: of records of table 10, what they report, in the words of the fusion system.
    """

    record: ResultRecord
    setting: Setting
    found: FoundObjects | None = None


class _Sent(NamedTuple):
    """What a result has to state of what was sent: rides along with it through the fusion system."""

    record: Any
    seq: int
    setting: Setting
    ticket: Ticket
    source: WholeRecord

    @property
    def extras(self) -> Mapping[str, Any]:
        return MappingProxyType({"sent": self})

    @property
    def image(self) -> ImageData:
        """The image as it was sent; it was checked when it came."""
        source = self.source
        if not isinstance(source, RawData):
            return cast("ImageData", source)
        encoding = str(self.setting.sensors[source.sensor_id].raw)
        return image_of_raw(source, self.setting.camera(source.sensor_id), encoding)


@dataclass(slots=True)
class Rig:
    """What a session's worker feeds: not for several threads at once.

    Each lidar has a fusion system of its own, whose ego frame is the lidar's: calibrations are of pairs, and those of
    two lidars need not agree on where a camera is. An image goes to all that its camera is calibrated with.

    Attributes:
        counters: where what goes wrong is counted.
        ledger: reported what became of each record.
    """

    counters: Counters
    ledger: Ledger
    _setting: Setting | None = None
    _systems: dict[int, FusionSystem] = field(default_factory=dict)
    _cameras: set[tuple[int, int]] = field(default_factory=set)
    _path: Poses | None = None
    _origin: Float64Array = field(default_factory=lambda: np.zeros(3))
    _trajectories: dict[int, Poses] = field(default_factory=dict)
    _newest_ns: dict[Stream, int] = field(default_factory=dict)
    _left: list[tuple[Ticket, Leave]] = field(default_factory=list)

    def feed(self, accepted: Accepted, ticket: Ticket) -> Iterator[RigResult]:
        """Take what a sensor sent, and give what could be fused with it."""
        sensor_id, received, setting = accepted.sensor_id, accepted.received, accepted.setting
        yield from self._adopt(setting)
        yield from self._follow_clock(accepted.stream, accepted.timestamp_ns)
        of_lidar = isinstance(received, LidarFrame | Boxes3d)
        kind = SensorKind.LIDAR if of_lidar else SensorKind.CAMERA
        pairs = setting.pairs_of(kind, sensor_id)
        lidar_ids = (sensor_id,) if of_lidar and pairs else tuple(sorted(lidar_id for _, lidar_id in pairs))
        self.ledger.share(ticket, len(lidar_ids))
        sent = _Sent(received, accepted.record.seq, setting, ticket, accepted.record)
        for lidar_id in lidar_ids:
            system = self._systems[lidar_id]
            try:
                self._send(system, lidar_id, sensor_id, sent)
            except Exception as error:  # noqa: BLE001 - one record must not end the session
                self._failed(sent.extras, error)
                self.ledger.settle(ticket, "failed")
            yield from self._fetch(lidar_id, system)

    def flush(self) -> Iterator[RigResult]:
        """Fuse all that waits with what has come."""
        for lidar_id, system in self._systems.items():
            system.flush()
            yield from self._fetch(lidar_id, system)

    def end(self) -> Iterator[RigResult]:
        """Fuse all that waits, and keep nothing."""
        for lidar_id, system in self._systems.items():
            system.end()
            yield from self._fetch(lidar_id, system)

    @property
    def waits(self) -> bool:
        """Whether a sweep or its boxes wait for an image."""
        return any(system.waits for system in self._systems.values())

    def move(self, path: Poses, *, origin: Float64Array) -> None:
        """Let the vehicle move along a trajectory from now on, whose positions count from `origin`, (3,) [m]."""
        self._path, self._origin = path, origin
        for lidar_id in self._systems:
            self._move(lidar_id)

    def _move(self, lidar_id: int) -> None:
        """Let a lidar ride on the body whose trajectory is reported, by the mounting in force."""
        if self._path is None or self._setting is None:
            return
        declared = self._setting.sensors.get(lidar_id)
        trajectory = trajectory_of_mounted(self._path, None if declared is None else declared.body_from_lidar)
        self._trajectories[lidar_id] = trajectory
        self._systems[lidar_id].move(trajectory, reach_ns=REACH_NS)

    def _follow_clock(self, stream: Stream, time_ns: int) -> Iterator[RigResult]:
        """Where a sensor's clock was set back, fuse all that waits, and begin anew."""
        newest_ns = self._newest_ns.get(stream, time_ns)
        self._newest_ns[stream] = max(newest_ns, time_ns)
        if time_ns >= newest_ns - CLOCK_JUMP_NS:
            return
        self._newest_ns = {stream: time_ns}
        for lidar_id, system in self._systems.items():
            system.restart(time_ns)
            yield from self._fetch(lidar_id, system)

    def _send(self, system: FusionSystem, lidar_id: int, sensor_id: int, sent: _Sent) -> None:
        axes = sent.setting.standard_from_lidar
        received: Received = sent.record
        extras = sent.extras
        if isinstance(received, LidarFrame):
            system.send(f"lidar{sensor_id}", replace(standard_frame(received, axes), extras=extras))
        elif isinstance(received, Boxes3d):
            boxes = boxes_3d_of(standard_boxes(received, axes), sensor_id=f"lidar{sensor_id}")
            system.send(f"lidar{sensor_id}", boxes, extras=extras)
        else:
            pair = sent.setting.pairs[sensor_id, lidar_id]
            mount = pair.lidar_from_camera
            if isinstance(received, CameraImage):
                image = replace(received, camera=pair.camera, mount=mount, extras=extras)
                system.send(f"camera{sensor_id}", image)
            else:
                seen = boxes_2d_of(received, sensor_id=f"camera{sensor_id}")
                system.send(f"camera{sensor_id}", SeenBoxes(seen, pair.camera, mount, extras))

    def _fetch(self, lidar_id: int, system: FusionSystem) -> Iterator[RigResult]:
        """Give what a system has fused, and settle what it does not keep any more."""
        for fused in iter(system.get, None):
            yield from self._sensor_data(lidar_id, fused)
        for found in iter(system.get_detections, None):
            yield from self._detections(lidar_id, found)
        left, self._left = self._left, []
        for ticket, leave in left:
            self.ledger.settle(ticket, leave.value)

    def _sensor_data(self, lidar_id: int, fused: FusedFrame) -> Iterator[RigResult]:
        sweep: _Sent = fused.extras["sent"]
        compensated = self._path is not None and not fused.stationary
        world_from_lidar = self._world_from_lidar(lidar_id, fused.reference_ns) if compensated else _HERE
        if self._path is not None and fused.stationary and sweep.setting.configuration.motion_compensation:
            self.counters.add("motion.beyond-reach")
        for view in fused.views:
            image: _Sent = fused.image_extras[view.camera_id]["sent"]
            try:
                record = sensor_fusion_record(
                    fused,
                    view,
                    world_from_lidar,
                    sweep.setting,
                    sent=sweep.record,
                    image=image.image,
                    camera_id=_number(view.camera_id),
                    lidar_id=lidar_id,
                    image_seq=image.seq,
                    points_seq=sweep.seq,
                    motion_compensated=compensated,
                )
            except Exception as error:  # noqa: BLE001 - an algorithm may be anyone's, and give anything
                self._failed(fused.extras, error)
                continue
            sweep.ticket.fused = image.ticket.fused = True
            yield RigResult(record, sweep.setting)

    def _detections(self, lidar_id: int, found: FusedDetectionFrame) -> Iterator[RigResult]:
        boxes_3d: _Sent = found.sweep_extras["sent"]
        boxes_2d: _Sent = found.image_extras["sent"]
        camera_id = _number(found.camera_id)
        compensated = self._path is not None and not found.stationary
        if self._path is not None and found.stationary and boxes_3d.setting.configuration.motion_compensation:
            self.counters.add("motion.beyond-reach")
        try:
            record = fused_detections_record(
                found,
                boxes_3d.record,
                boxes_2d.record,
                boxes_3d.setting,
                camera=boxes_2d.setting.pairs[camera_id, lidar_id].camera,
                lidar_id=lidar_id,
                camera_id=camera_id,
                motion_compensated=compensated,
            )
        except Exception as error:  # noqa: BLE001 - an algorithm may be anyone's, and give anything
            self._failed(found.sweep_extras, error)
            return
        boxes_3d.ticket.fused = boxes_2d.ticket.fused = True
        for kind, sent, used in (
            ("boxes_3d", boxes_3d, record.box_3d_ids),
            ("boxes_2d", boxes_2d, record.box_2d_ids),
        ):
            # several objects may be made of one box, and a box may have the id of another
            self.counters.add(f"left-out.{kind}", max(len(sent.record) - len(used) + used.count(None), 0))
        world_from_lidar = self._world_from_lidar(lidar_id, found.timestamp_ns) if compensated else _HERE
        origin = self._origin if compensated else _HERE.translation
        yield RigResult(
            record, boxes_3d.setting, FoundObjects(found, world_from_lidar, origin, boxes_3d.setting)
        )

    def _adopt(self, setting: Setting) -> Iterator[RigResult]:
        """Go by another configuration from this record on; gives what waited only for cameras that are gone."""
        if setting is self._setting:
            return
        self._setting = setting
        for camera_id, lidar_id in setting.pairs:
            if lidar_id not in self._systems:
                self._systems[lidar_id] = self._system(lidar_id, setting)
            if (camera_id, lidar_id) not in self._cameras:
                self._systems[lidar_id].add_camera(f"camera{camera_id}", _AT_LIDAR, index=camera_id % 255)
                self._cameras.add((camera_id, lidar_id))
            declared = setting.sensors.get(camera_id)
            shutter = GLOBAL if declared is None else declared.shutter
            self._systems[lidar_id].roll(f"camera{camera_id}", shutter)
        for lidar_id, system in self._systems.items():
            system.configure(setting.configuration, period_ns=setting.sweep_period_ns)
            self._move(lidar_id)
            system.expect([f"camera{camera}" for camera, lidar in setting.pairs if lidar == lidar_id])
            yield from self._fetch(lidar_id, system)

    def _system(self, lidar_id: int, setting: Setting) -> FusionSystem:
        system = FusionSystem(
            setting.configuration,
            on_unreadable=self._unreadable,
            on_failed=self._failed,
            on_left=self._leave,
        )
        system.add_lidar(f"lidar{lidar_id}", _AT_LIDAR, period_ns=setting.sweep_period_ns, location=_AT_LIDAR)
        return system

    def _unreadable(self, error: DataError) -> None:
        del error
        self.counters.add("errors.unreadable-image")

    def _failed(self, extras: Mapping[str, Any], error: Exception) -> None:
        self.counters.add(f"errors.{type(error).__name__}")
        sent: _Sent = extras["sent"]
        sent.ticket.support = sent.ticket.support or "failed"

    def _leave(self, extras: Mapping[str, Any], leave: Leave) -> None:
        sent: _Sent = extras["sent"]
        self._left.append((sent.ticket, leave))

    def _world_from_lidar(self, lidar_id: int, time_ns: int) -> RigidTransform:
        if lidar_id not in self._trajectories:
            return _HERE
        pose = PoseSource(self._trajectories[lidar_id], _HERE, REACH_NS).at(np.array([time_ns], np.int64))
        if (
            pose.coverage[0] == OUT_OF_REACH
        ):  # which only a sweep without points can be, if it was compensated
            return _HERE
        return RigidTransform.from_quaternion(pose.positions[0], pose.quaternions_xyzw[0])


def _number(camera_id: object) -> int:
    return int(str(camera_id).removeprefix("camera"))


_HERE = RigidTransform.identity()
_AT_LIDAR = PoseSource(STILL, _HERE)
