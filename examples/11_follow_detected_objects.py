"""Fuse what two detectors found, follow the objects, and make labels of their tracks.

A street with traffic is simulated, and two detectors with known errors look at it: one at the sweeps, one at the
images. What they find goes into two lists, as lines of JSON; then objects are followed through the drive by both
together, and their tracks become cuboids, objects and boxes in images. `sceneloom track` does the same from files.

    python examples/11_follow_detected_objects.py [FOLDER]
"""

import sys
from pathlib import Path

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.db34t.json import format_json
from sceneloom.db34t.scene_objects import boxes_2d_record, boxes_3d_record
from sceneloom.pipeline import DetectionFiles, DetectionInput
from sceneloom.simulate import CameraSpec, LidarSpec, TrafficSpec, detect_2d, detect_3d

CAMERA_MODEL = Camera("pinhole", 320, 160, 190.0, 190.0, 159.5, 79.5)

if __name__ == "__main__":
    where = Path(sys.argv[1] if len(sys.argv) > 1 else "detected")
    drive = sceneloom.simulate_street(
        4,
        frames=4,
        lidar=LidarSpec(beams=16, steps=240),
        cameras=[CameraSpec(CAMERA_MODEL)],
        traffic=TrafficSpec(cars=4),
    )
    where.mkdir(parents=True, exist_ok=True)
    sceneloom.write(drive.scene, where / "drive", format="recording", overwrite=True)
    lists = {
        "sweeps.jsonl": [boxes_3d_record(r.boxes, sensor_id=0, seq=k) for k, r in enumerate(detect_3d(drive))],
        "images.jsonl": [boxes_2d_record(r.boxes, sensor_id=1, seq=k) for k, r in enumerate(detect_2d(drive))],
    }
    for name, records in lists.items():
        (where / name).write_text("\n".join(map(format_json, records)) + "\n", "utf-8")

    files = DetectionFiles(boxes_3d=(where / "sweeps.jsonl",), boxes_2d=(where / "images.jsonl",))
    chosen = DetectionInput(files=files)
    report = sceneloom.track_objects(where / "drive", where / "labels.sfs", chosen=chosen, overwrite=True)
    tracks = ", ".join(f"{count} of class {name}" for name, count in report.drives[0].tracks.items())
    print(f"tracks in {report.drives[0].frames} sweeps: {tracks}")

    with sceneloom.open(where / "labels.sfs") as scene:
        for annotation in scene.annotations[:6]:
            print(f"{annotation.id}: {annotation.type} {annotation.label}")
