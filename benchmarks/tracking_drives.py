"""Simulated crowds and motorways as a folder like KITTI's tracking benchmark, for `benchmarks.tracking`.

    python -m benchmarks.tracking_drives FOLDER [--drives 5] [--frames 80] [--seed 1000]
    python -m benchmarks.tracking FOLDER [--cross-validate]

A crowd: 20 pedestrians on 100 m of each pavement, and the usual traffic; a motorway: 26 to 33 m/s, oncoming traffic as
fast, no pedestrians. Detections are those of `simulate.detect_3d` and `simulate.detect_2d` with their defaults, amodal
in images. Labels follow KITTI: objects lower than 25 px are regions in which nothing counts; `truncated` is 1 at the
image's border; `occluded` is 0 up to 10 % hidden, 1 up to 50 %, 2 up to 90 %, and 3, which does not count, beyond. A
frame takes some three seconds, on two processors half.
"""

import argparse
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sceneloom.formats.kitti.benchmark_writer import write_labels
from sceneloom.formats.kitti.calibration import Mounted, write_calibration
from sceneloom.formats.kitti.labels import NO_TRACK, TYPES, KittiLabels, joined_labels
from sceneloom.formats.kitti.oxts import oxts_lines
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.pipeline.detected_drive import KittiObjects, kitti_labels
from sceneloom.scene import Boxes2D, Boxes3D, PointsFrame, ScoreForm
from sceneloom.simulate import (
    Detector2dSpec,
    Detector3dSpec,
    PathSpec,
    ScoreSpec,
    SimulatedDetections,
    SimulatedDrive,
    TrafficSpec,
    detect_2d,
    detect_3d,
    simulate_street,
)

_CLASSES = ("car", "pedestrian")
_CAMERA = 2
_LEAST_HEIGHT_PX, _BORDER_PX, _HIDDEN = 25.0, 0.5, (0.1, 0.5, 0.9)

KINDS: dict[str, dict[str, Any]] = {
    "crowd": {"traffic": TrafficSpec(cyclists=0.0, pedestrians=20.0)},
    "motorway": {
        "path": PathSpec(speeds=(26.0, 33.0), yaw_rate=0.05),
        "traffic": TrafficSpec(cars=3.0, cyclists=0.0, pedestrians=0.0, oncoming=(26.0, 33.0)),
    },
}


def pose(drive: SimulatedDrive, time_ns: int) -> RigidTransform:
    """`world_from_ego`."""
    states = drive.truth.path.at(np.array([time_ns], np.int64))
    return RigidTransform(states.rotations[0], states.positions[0])


class Layout:
    """Writes the files of one drive."""

    def __init__(self, drive: SimulatedDrive, folder: Path, name: str) -> None:
        self.drive, self.folder, self.file = drive, folder, f"{name}.txt"
        self.camera = drive.scene.cameras[0]
        self.lidar_from_ego = drive.truth.lidar.spec.mount.inverse()
        self.rectified_from_lidar = self.camera.mount.inverse() @ drive.truth.lidar.spec.mount
        times_ns = drive.truth.cameras[str(self.camera.id)].timestamps_ns
        self.path = drive.truth.world_from_ego(times_ns)
        self.lidar_from_world = [self.lidar_from_ego @ pose(drive, int(time_ns)).inverse() for time_ns in times_ns]

    def place(self, *parts: str) -> Path:
        """A file of the drive, whose folder is made."""
        path = self.folder.joinpath(*parts) / self.file
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def objects(self, frame: int, ids: np.ndarray, corners_xyxy: np.ndarray, boxes: Boxes3D) -> KittiObjects:
        """Boxes of the lidar and in the image of one frame."""
        labels = tuple(label.capitalize() for label in boxes.labels)
        placed = boxes.centers, boxes.sizes_lwh, boxes.yaws
        return KittiObjects(frame, ids, labels, boxes.scores, corners_xyxy, placed, self.camera.camera)

    def true_boxes(self, frame: int, ids: np.ndarray) -> Boxes3D:
        """Boxes of some instances, in the lidar's frame."""
        time_ns = int(self.path.timestamps_ns[frame])
        every = self.drive.truth.boxes([time_ns])
        rows = np.searchsorted(every.instances, ids)
        labels = tuple(every.labels[row] for row in rows)
        placed = every.centers_world[0, rows], every.sizes_lwh[rows], every.yaws[0, rows]
        boxes = Boxes3D(time_ns, *placed, np.ones(len(rows)), labels, frame=PointsFrame.WORLD)
        return boxes.moved(self.lidar_from_world[frame], PointsFrame.SENSOR)

    def write_labels(self, images: list[SimulatedDetections[Boxes2D]]) -> None:
        """The true objects, or regions where they are too low."""
        parts, size = list[KittiLabels](), np.array([self.camera.camera.width, self.camera.camera.height], np.float64)
        for frame, image in enumerate(images):
            ids, corners = image.truth_instances, image.truth.corners_xyxy
            cut = ((corners[:, :2] < _BORDER_PX) | (corners[:, 2:] > size - _BORDER_PX)).any(axis=1)
            found = kitti_labels(
                [self.objects(frame, ids, corners, self.true_boxes(frame, ids))], self.rectified_from_lidar
            )
            assert len(found) == len(ids)  # all of them are in the image
            low = corners[:, 3] - corners[:, 1] < _LEAST_HEIGHT_PX
            parts.append(
                replace(
                    found,
                    types=tuple("DontCare" if few else word for few, word in zip(low, found.types, strict=True)),
                    track_ids=np.where(low, NO_TRACK, found.track_ids),
                    truncations=cut.astype(np.float64),
                    occlusions=np.searchsorted(_HIDDEN, image.occlusions).astype(np.int64),
                    scores=None,
                )
            )
        write_labels(joined_labels(parts), self.place("label_02"))

    def write_image_boxes(self, images: list[SimulatedDetections[Boxes2D]]) -> None:
        """The lists of the detector in images."""
        for label in _CLASSES:
            lines = list[str]()
            for frame, image in enumerate(images):
                own = np.array([one == label for one in image.boxes.labels], np.bool_)
                rows = np.column_stack([image.boxes.corners_xyxy - 0.5, image.boxes.scores])[own]
                lines += [f"{frame},{','.join(f'{value:.4f}' for value in row)}\n" for row in rows]
            self.place("det2d_simulated", label.capitalize()).write_text("".join(lines))

    def write_sweep_boxes(self, sweeps: list[SimulatedDetections[Boxes3D]]) -> None:
        """The lists of the detector in sweeps, whose outlines in the image nobody reads."""
        numbers = {name: number for number, name in TYPES.items()}
        whole = np.array([[0.0, 0.0, float(self.camera.camera.width), float(self.camera.camera.height)]])
        for label in _CLASSES:
            lines = list[str]()
            for frame, sweep in enumerate(sweeps):
                own = sweep.boxes.select(np.flatnonzero([one == label for one in sweep.boxes.labels]))
                shown = self.objects(frame, np.zeros(len(own), np.int64), np.repeat(whole, len(own), axis=0), own)
                found = kitti_labels([shown], self.rectified_from_lidar)
                for row in np.column_stack([found.values, found.alphas])[:, [3, 4, 5, 6, 14, *range(7, 14), 15]]:
                    numbers_text = ",".join(f"{value:.4f}" for value in row)
                    lines.append(f"{frame},{numbers[label.capitalize()]},{numbers_text}\n")
            self.place("det3d_simulated", label.capitalize()).write_text("".join(lines))

    def write(self, sweeps: list[SimulatedDetections[Boxes3D]], images: list[SimulatedDetections[Boxes2D]]) -> None:
        """All files."""
        lines = oxts_lines(self.drive.scene, self.path, self.path.timestamps_ns)
        self.place("oxts").write_text("\n".join(lines.texts()) + "\n")
        mounted = Mounted(
            {_CAMERA: self.camera.camera}, {_CAMERA: self.rectified_from_lidar}, self.lidar_from_ego, _CAMERA
        )
        write_calibration(self.place("calib"), "tracking", mounted, None)
        self.write_labels(images)
        self.write_image_boxes(images)
        self.write_sweep_boxes(sweeps)


def lay_out(folder: Path, frames: int, kind: str, seed: int) -> str:
    """Simulate one drive, detect what is in it, and write it; gives its name."""
    name = f"{kind}_{seed}"
    drive = simulate_street(seed, frames=frames, **KINDS[kind])
    some = Detector3dSpec().classes, Detector2dSpec().classes
    three, two = ({label: classes[label] for label in _CLASSES} for classes in some)
    sweeps = detect_3d(drive, Detector3dSpec(classes=three, scores=ScoreSpec(form=ScoreForm.LOGIT), seed=seed))
    images = detect_2d(drive, spec=Detector2dSpec(classes=two, amodal=True, seed=seed))
    Layout(drive, folder, name).write(sweeps, images)
    return name


def main() -> None:
    """Write all drives."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--drives", type=int, default=5, help="of each kind")
    parser.add_argument("--frames", type=int, default=80)
    parser.add_argument("--seed", type=int, default=1000, help="of the first drive")
    reported = parser.parse_args()
    write: Callable[[str, int], str] = partial(lay_out, reported.folder, reported.frames)
    seeds = range(reported.seed, reported.seed + reported.drives)
    with ProcessPoolExecutor(2) as processes:
        for name in processes.map(write, *zip(*((kind, seed) for seed in seeds for kind in KINDS), strict=True)):
            print(name, flush=True)


if __name__ == "__main__":
    main()
