"""Real drives in folders behind URLs: what they hold on disk, fetched when it is read."""

import hashlib

import pytest

import sceneloom
from sceneloom.formats.remote import stores


def content(scene):
    """All points and images, and how many annotations there are."""
    stated = hashlib.sha256()
    for cloud in [sensor for sensor in scene.sensors if sensor.type in ("lidar", "radar")]:
        for frame in cloud.frames:
            stated.update(repr(frame.timestamp_ns).encode() + frame.points.positions.tobytes())
    for camera in scene.cameras:
        for image in camera.images:
            stated.update(repr((image.timestamp_ns, image.camera)).encode() + image.rgb.tobytes())
    return stated.hexdigest(), len(scene.annotations)


@pytest.mark.parametrize(
    ("location", "options", "share"),
    [
        ("recordings/kitti_drive", {}, 0.05),
        ("recordings/pandaset", {}, 0.15),
        ("real/argoverse2", {}, 0.3),
        ("real/kitti_object", {}, 0.3),
        ("real/kitti_tracking", {"sequence": "0013"}, None),
        ("real/pandaset_scale_sample", {}, 0.7),
    ],
)
@pytest.mark.few(3)
def test_folders_hold_what_they_hold_on_disk_and_opening_takes_a_part(data_dir, monkeypatch, location, options, share):
    if location.endswith("argoverse2"):
        pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    fetched, get = [], stores.Store.get

    def noted(self, target):
        get(self, target)
        fetched.append(target.stat().st_size)

    monkeypatch.setattr(stores.Store, "get", noted)
    folder = data_dir / location
    whole = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    with sceneloom.open(folder, **options) as local, sceneloom.open(f"local://{folder}", **options) as remote:
        if share is not None:
            assert sum(fetched) < share * whole
        assert content(remote) == content(local)
