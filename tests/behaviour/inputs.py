"""Drives and small folders that the commands of the snapshot read: `python -m tests.behaviour.inputs FOLDER`."""

import sys
from pathlib import Path

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.colouring.cuboid_projection import project_cuboids
from sceneloom.db34t.json import format_json
from sceneloom.db34t.scene_objects import boxes_2d_record, boxes_3d_record
from sceneloom.simulate import (
    CameraSpec,
    Faults,
    GnssSpec,
    ImuSpec,
    LidarSpec,
    PathSpec,
    RadarSpec,
    SensorFaults,
    annotate,
    detect_2d,
    detect_3d,
    inject,
    sensor_mount,
    simulate_street,
)


def make_inputs(folder: Path) -> None:
    """Write a drive with all kinds of sensors and boxes, its detections, a half of it, drives to calibrate, others."""
    from tests.unit.formats.euroc_mav.test_reader import write_drive as write_euroc_mav
    from tests.unit.formats.pandaset.test_reader import write_drive as write_pandaset
    from tests.unit.formats.rig.conftest import write_folder

    camera = CameraSpec(Camera("pinhole", 320, 200, 180.0, 180.0, 159.5, 99.5))
    drive = annotate(
        simulate_street(
            1,
            frames=6,
            lidar=LidarSpec(beams=16, steps=360),
            cameras=(camera,),
            radars=(RadarSpec(),),
            imu=ImuSpec(),
            gnss=GnssSpec(),
        )
    )
    sceneloom.write(project_cuboids(drive.scene), folder / "drive.sfs")
    for name, reports, record in (
        ("boxes3d.jsonl", detect_3d(drive), boxes_3d_record),
        ("boxes2d.jsonl", detect_2d(drive), boxes_2d_record),
    ):
        lines = [format_json(record(report.boxes, sensor_id=0, seq=k)) for k, report in enumerate(reports)]
        (folder / name).write_text("\n".join(lines))
    content = (folder / "drive.sfs").read_bytes()
    (folder / "cut.sfs").write_bytes(content[: len(content) * 3 // 5])

    rotated = simulate_street(
        5,
        frames=6,
        cameras=[CameraSpec(Camera("pinhole", 414, 126, 240.0, 240.0, 206.5, 62.5))],
        lidar=LidarSpec(beams=40, steps=900),
        path=PathSpec(speeds=(10.0, 12.0)),
    )
    wrong = Faults({"camera0": SensorFaults(rotation_deg=(0.5, -0.6, 0.4))})
    sceneloom.write(inject(rotated, wrong).scene, folder / "rotated", images="png")

    corner = sensor_mount(position=(1.5, 0.6, 0.9), yaw_deg=70.0, pitch_deg=3.0, roll_deg=-4.0)
    lidars = (
        LidarSpec(beams=32, steps=600),
        LidarSpec(beams=16, steps=600, elevations_deg=(-30.0, 10.0), mount=corner),
    )
    sceneloom.write(simulate_street(3, frames=3, lidars=lidars).scene, folder / "two_lidars", images="png")

    write_euroc_mav(folder)
    (folder / "rig").mkdir()
    write_folder(folder / "rig")
    (folder / "pandaset").mkdir()
    write_pandaset(folder / "pandaset")


if __name__ == "__main__":
    make_inputs(Path(sys.argv[1]))
