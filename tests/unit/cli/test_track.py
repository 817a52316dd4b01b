"""`sceneloom track` on a small synthetic folder of KITTI's tracking benchmark."""

import json

import numpy as np
import pytest

import sceneloom
from sceneloom.formats.kitti.labels import read_labels

FRAMES = 8
FOCAL, CX, CY = 707.0493, 604.0814, 180.5066
CALIB = (
    f"P2: {FOCAL} 0 {CX} 0 0 {FOCAL} {CY} 0 0 0 1 0\n"
    "R_rect 1 0 0 0 1 0 0 0 1\nTr_velo_cam 0 -1 0 0 0 0 -1 0 1 0 0 0\nTr_imu_velo 1 0 0 0 0 1 0 0 0 0 1 0\n"
)
SPEED = 0.5
"""The ego drives so far from frame to frame, to the east [m]; a degree of longitude on the equator is 111319.49 m."""
SIZE_HWL = (1.5, 1.6, 4.0)
PEOPLE_HWL = (1.8, 0.6, 0.8)


def locations(frame):
    """Where the middle of the bottom of a car and a person is in the camera's frame: both stand in the world."""
    return {"Car": (3.0, 1.6, 25.0 - SPEED * frame), "Pedestrian": (-4.0, 1.6, 15.0 - SPEED * frame)}


def outline(location, size_hwl):
    """The box in the image of a box whose length lies along x of the camera, by its eight corners."""
    h, w, length = size_hwl
    xs, zs = (-length / 2, length / 2), (-w / 2, w / 2)
    corners = np.array([[x, y, z] for x in xs for y in (-h, 0) for z in zs]) + location
    u, v = FOCAL * corners[:, 0] / corners[:, 2] + CX, FOCAL * corners[:, 1] / corners[:, 2] + CY
    return u.min(), v.min(), u.max(), v.max()


@pytest.fixture
def folder(tmp_path):
    """Eight frames with a car and a person, both found by both detectors; labels that must never be read."""
    root = tmp_path / "kitti"
    texts = {"calib/0003.txt": CALIB, "label_02/0003.txt": "not to be read"}
    texts["oxts/0003.txt"] = "".join(f"0 {SPEED * k / 111319.4908:.12f}" + " 0" * 28 + "\n" for k in range(FRAMES))
    for label, number, size in (("Car", 2, SIZE_HWL), ("Pedestrian", 1, PEOPLE_HWL)):
        two, three = "", ""
        for k in range(FRAMES):
            location = locations(k)[label]
            box = ",".join(f"{value:.4f}" for value in outline(location, size))
            two += f"{k},{box},0.98\n"
            numbers = ",".join(map(str, (*size, *location)))
            three += f"{k},{number},{box},6.0,{numbers},0.0,0.0\n"
        texts[f"det2d_x/{label}/0003.txt"], texts[f"det3d_y/{label}/0003.txt"] = two, three
    for name, text in texts.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    return root


def results(output):
    """Frame by frame, the rows of a class."""
    found = read_labels(output / "0003.txt")
    assert found.scores is not None
    return found, {label: np.flatnonzero([word == label for word in found.types]) for label in set(found.types)}


def test_what_stands_has_one_track_whose_boxes_are_where_it_is(succeeds, folder, tmp_path):
    succeeds("track", folder, "-o", tmp_path / "out")
    found, rows = results(tmp_path / "out")
    assert sorted(rows) == ["Car", "Pedestrian"]
    for label, size in (("Car", SIZE_HWL), ("Pedestrian", PEOPLE_HWL)):
        own = rows[label]
        assert len(set(found.track_ids[own].tolist())) == 1
        assert len(own) >= FRAMES - 2  # a tracker may wait for a second box before it reports an object
        for row in own.tolist():
            truth = locations(int(found.frames[row]))[label]
            # 0.3 m, 4 px: what a filter and typical errors of detectors may move a perfect box
            np.testing.assert_allclose(found.bottoms[row], truth, atol=0.3)
            np.testing.assert_allclose(found.corners_xyxy[row], outline(truth, size), atol=4.0)
    assert len({found.track_ids[own[0]] for own in rows.values()}) == 2
    # projected boxes are the outlines of those in space
    succeeds("track", folder, "-o", tmp_path / "projected", "--box2d", "projected")
    found, _ = results(tmp_path / "projected")
    for k in range(len(found)):
        h, w, length = found.sizes_hwl[k]
        rotation, (x, y, z) = found.rotations_y[k], found.bottoms[k]
        i, j, up = np.array([(i, j, up) for i in (-0.5, 0.5) for j in (-0.5, 0.5) for up in (0.0, h)]).T
        along, across = i * length, j * w
        x, y = x + np.cos(rotation) * along + np.sin(rotation) * across, y - up
        seen = np.stack([x, y, z - np.sin(rotation) * along + np.cos(rotation) * across], axis=1)
        u, v = FOCAL * seen[:, 0] / seen[:, 2] + CX, FOCAL * seen[:, 1] / seen[:, 2] + CY
        # 0.2 px: how closely edges are followed; no box is at the border of the image
        np.testing.assert_allclose(found.corners_xyxy[k], [u.min(), v.min(), u.max(), v.max()], atol=0.2)


@pytest.mark.parametrize(
    "gone",
    [
        *(("oxts",), ("det2d_x",), ("det3d_y",), ("det2d_x/Pedestrian",), ("det3d_y/Car",)),
        ("det2d_x/Pedestrian", "det3d_y/Pedestrian"),
    ],
)
def test_what_is_missing_is_reported_and_the_rest_is_tracked(succeeds, folder, tmp_path, gone):
    for name in gone:
        for file in (folder / name).rglob("*.txt"):
            file.unlink()
        (folder / name).rename(folder / f"gone_{name.replace('/', '_')}")
    succeeds("track", folder, "-o", tmp_path / "out")
    _, rows = results(tmp_path / "out")
    expected = {"Car", "Pedestrian"} - ({"Pedestrian"} if len(gone) == 2 else set())
    assert set(rows) == expected


def test_a_sequence_is_chosen_drawn_and_overwritten_on_request_only(refuses, succeeds, folder, tmp_path):
    words, look = ("track", folder, "-o", tmp_path / "out"), tmp_path / "look"
    (folder / "calib" / "0009.txt").write_text(CALIB)
    refuses(2, "done whole", *words, "--stop", 0.3)
    refuses(2, "sequence '0001'", *words, "--sequence", "0001")
    succeeds(*words, "--sequence", "3", "--visualize", look)
    assert [file.name for file in (tmp_path / "out").iterdir()] == ["0003.txt"]
    drawn = sorted(path.relative_to(look).as_posix() for path in look.rglob("*.png"))
    assert (drawn[0], len(drawn)) == ("0003/000000_above.png", FRAMES)
    (folder / "calib" / "0009.txt").unlink()
    refuses(1, "exists already", *words)
    for file in folder.glob("det*/*/*.txt"):
        file.write_text("")
    succeeds(*words, "--overwrite")
    assert (tmp_path / "out" / "0003.txt").read_text() == ""


def test_faulty_lists_are_reported_with_their_lines_and_several_detectors_are_a_question(
    refuses, succeeds, folder, tmp_path
):
    words = ("track", folder, "-o", tmp_path / "out")
    (folder / "det2d_x/Car/0003.txt").write_text("0,1,1,9,9,0.5\n0,1,car\n")
    refuses(1, "det2d_x/Car/0003.txt: line 2: 3 values; expected 6", *words)
    (folder / "det2d_z" / "Car").mkdir(parents=True)
    refuses(2, "choose one with `--det2d NAME`", *words, "--lenient")
    assert not (tmp_path / "out").exists()
    succeeds(*words, "--lenient", "--det2d", "x")


@pytest.mark.parametrize("offline", [(), ("--offline",)])
def test_lines_of_json_report_the_world(succeeds, folder, tmp_path, offline):
    succeeds("track", folder, "-o", tmp_path / "out", "--format", "jsonl", *offline)
    lines = [json.loads(line) for line in (tmp_path / "out" / "0003.jsonl").read_text().splitlines()]
    assert [line["timestamp_ns"] for line in lines] == [k * 100_000_000 for k in range(FRAMES)]
    car = next(one for one in lines[-1]["objects"] if one["class"] == "Car")
    # by hand: the car's middle in the camera's frame of frame 0, as east, north and up of there
    np.testing.assert_allclose(car["center"], [25.0, -3.0, -0.85], atol=0.3)
    assert len(car["center_cov"]) == len(car["size_cov"]) == 9
    assert np.hypot(*car["velocity"][:2]) < 1.0


def test_labels_of_a_scene_are_cuboids_and_what_does_not_go_with_the_form_is_refused(
    refuses, reported, succeeds, folder, tmp_path, monkeypatch
):
    words = ("track", folder, "-o", tmp_path / "out", "--format", "sfs")
    report = reported(*words)
    assert (report["form"], report["drives"][0]["frames"]) == ("sfs", FRAMES)
    assert report["drives"][0]["tracks"] == {"Car": 1, "Pedestrian": 1}
    with sceneloom.open(tmp_path / "out" / "0003.sfs") as scene:
        assert [one.type for one in scene.annotations].count("cuboid") == 2
    # Scale's validator knows no such sensor, so a scene of this profile keeps it aside
    outcome = succeeds(*words, "--profile", "scale", "--overwrite")
    assert "sensors[ego]: Scale's validator knows no such sensor" in outcome.err
    monkeypatch.chdir(folder)
    for wrong, stated in (
        ("x --profile scale", "--profile: only of scenes, but 'kitti' is written"),
        ("x.sfs", "x.sfs: a folder is written, a file for each drive"),
        ("x.txt --format jsonl", "expected a name without '.txt'"),
    ):
        refuses(2, stated, "track", folder, "-o", *wrong.split())
    assert list(folder.glob("x*")) == []
