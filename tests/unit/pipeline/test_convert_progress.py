"""A conversion reports how far it is."""

from sceneloom.cameras.camera import Camera
from sceneloom.formats import open_scene, write_scene
from sceneloom.pipeline import convert
from sceneloom.simulate import CameraSpec, LidarSpec, simulate_street


def test_every_sweep_and_every_single_image_is_reported_once(tmp_path):
    camera_model = Camera("pinhole", 64, 32, 40.0, 40.0, 31.5, 15.5)
    drive = simulate_street(frames=3, lidar=LidarSpec(beams=4, steps=60), cameras=(CameraSpec(camera_model),))
    write_scene(drive.scene, tmp_path / "drive.sfs")
    reported = []
    convert(
        tmp_path / "drive.sfs",
        tmp_path / "copy.sfs",
        progress=lambda done, total: reported.append((done, total)),
    )
    assert reported[-1] == (6, 6)
    assert [done for done, _ in reported] == sorted(done for done, _ in reported)
    with open_scene(tmp_path / "copy.sfs") as copy:
        assert [len(copy.lidars[0].frames), len(copy.cameras[0].images)] == [3, 3]
