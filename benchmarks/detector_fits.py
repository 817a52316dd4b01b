"""Fit the numbers of detectors that come with the package, `src/sceneloom/detections/fitted/*.toml`.

Run with `python -m benchmarks.detector_fits simulated` or `python -m benchmarks.detector_fits kitti FOLDER`, FOLDER
laid out like KITTI's tracking benchmark with the lists of two detectors beside the labels. `-o FILE` writes elsewhere,
`--sequences 0000,0002` takes some sequences only. For detectors of your own, make `LabelledPair`s as `kitti_examples`
does, and call `sceneloom.detections.fitting.fit_detectors`.
"""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from sceneloom.detections import DetectionPair
from sceneloom.detections.detectors import FOLDER, format_detectors
from sceneloom.detections.fitting import FitSettings, LabelledPair, fit_detectors
from sceneloom.formats.base.output import replacing
from sceneloom.formats.kitti.labels import CENTRE_TO_CORNER, lidar_boxes, read_labels
from sceneloom.formats.kitti.tracking_reader import open_tracking_folder
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import Boxes3D
from sceneloom.simulate import Detector2dSpec, Detector3dSpec, SimulatedDrive, detect_2d, detect_3d, simulate_street

KITTI = "kitti_rrc_pointrcnn"
NEIGHBOURS = {"Van": "Car", "Person_sitting": "Pedestrian"}
"""Classes whose objects look like those of another one, and which detectors need not distinguish."""


def kitti_examples(folder: Path, sequences: Sequence[str] | None = None) -> Iterator[LabelledPair]:
    """Every sweep and image of KITTI's sequences with their labels; objects of moderate difficulty count."""
    drives = open_tracking_folder(folder)
    for name in sequences or drives.sequences:
        drive, labels = drives.sequence(name), read_labels(folder / "label_02" / f"{name}.txt")
        for frame in range(drive.frame_count):
            now = labels.frames == frame
            types = np.array(labels.types, object)[now]
            neighbours = np.isin(types, list(NEIGHBOURS))
            rows = np.flatnonzero(neighbours | np.isin(types, ["Car", "Pedestrian"]))
            corners = labels.corners_xyxy[now]
            plain = (labels.occlusions[now] <= 1) & (labels.truncations[now] <= 0.3)
            counts = ~neighbours & plain & (corners[:, 3] - corners[:, 1] > 25.0)
            placed = lidar_boxes(
                labels.sizes_hwl[now][rows],
                labels.bottoms[now][rows],
                labels.rotations_y[now][rows],
                drive.rectified_from_lidar,
            )
            words = tuple(NEIGHBOURS.get(str(types[row]), str(types[row])) for row in rows)
            time_ns = int(drive.timestamps_ns[frame])
            truth = Boxes3D(time_ns, *placed, np.ones(len(rows)), words)
            pair = DetectionPair(drive.boxes_3d(frame), drive.boxes_2d(frame), drive.camera, drive.camera_from_lidar)
            regions, drawn = corners[types == "DontCare"], corners[rows] + CENTRE_TO_CORNER
            ids = labels.track_ids[now][rows]
            yield LabelledPair(pair, truth, counts[rows], neighbours[rows], regions, name, drawn_xyxy=drawn, ids=ids)


DRIVES, FRAMES, STEP = 12, 120, 10


def simulated_examples() -> Iterator[LabelledPair]:
    """Sweeps and images of streets that are made up, and of detectors whose errors are drawn."""
    for seed in range(DRIVES):
        drive = simulate_street(seed, frames=FRAMES)
        lidar, camera = drive.scene.lidars[0], drive.scene.cameras[0]
        some = range(0, FRAMES, STEP)
        sweeps = detect_3d(drive, Detector3dSpec(seed=seed), frames=some)
        images = detect_2d(drive, spec=Detector2dSpec(seed=seed, amodal=True), frames=some)
        for sweep, image in zip(sweeps, images, strict=True):
            world_from_lidar = _pose(drive, sweep.boxes.timestamp_ns) @ lidar.mount
            world_from_camera = _pose(drive, image.boxes.timestamp_ns) @ camera.mount
            camera_from_lidar = world_from_camera.inverse() @ world_from_lidar
            yield LabelledPair(
                DetectionPair(sweep.boxes, image.boxes, camera.camera, camera_from_lidar),
                sweep.truth,
                np.ones(len(sweep.truth), np.bool_),
                np.zeros(len(sweep.truth), np.bool_),
                np.zeros((0, 4)),
                f"{seed}",
                least_height_px=10.0,
            )


def _pose(drive: SimulatedDrive, time_ns: int) -> RigidTransform:
    pose = drive.truth.path.at(np.array([time_ns], np.int64))
    return RigidTransform(pose.rotations[0], pose.positions[0])


def main() -> None:
    """Fit, and write the file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("simulated", "kitti"))
    parser.add_argument("folder", nargs="?", type=Path)
    parser.add_argument("--sequences", type=lambda text: text.split(","))
    parser.add_argument("-o", "--output", type=Path)
    reported = parser.parse_args()
    if reported.what == "kitti":
        names = reported.sequences or open_tracking_folder(reported.folder).sequences
        found = fit_detectors(
            kitti_examples(reported.folder, names),
            name=KITTI,
            settings=FitSettings(otherwise="car"),
            provenance={
                "detectors": "RRC in images, PointRCNN in sweeps; PointRCNN learned on KITTI",
                "data": f"KITTI tracking, sequences {' '.join(names)}",
                "fitted_by": "benchmarks/detector_fits.py",
            },
        )
    else:
        found = fit_detectors(
            simulated_examples(),
            name="simulated",
            settings=FitSettings(otherwise="car", overlap=0.25, surest_3d=7.0, least_count=80),
            provenance={
                "detectors": "simulate.detect_2d, simulate.detect_3d with their defaults",
                "data": f"{DRIVES} simulated streets, every {STEP}th of {FRAMES} sweeps, seeds 0 to {DRIVES - 1}",
                "fitted_by": "benchmarks/detector_fits.py",
            },
        )
    path = reported.output or FOLDER / f"{found.name}.toml"
    with replacing(path, overwrite=True) as target:
        target.write_text(format_detectors(found), "utf-8")


if __name__ == "__main__":
    main()
