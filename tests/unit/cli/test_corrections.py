"""Corrections of a scene, through every verb: what computes applies them, other edits keep them, nothing does twice."""

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from tests.unit.cli.conftest import verbs, write_boxes

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.catalog.building import read_draft, read_drive
from sceneloom.cli.main import sceneloom as command_line
from sceneloom.formats.trajectories.table import read_trajectory
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.pipeline.calibrating import check_drive
from sceneloom.scene import AttributePath, CameraCalibration, CuboidAnnotation, LocalizationAdjustment, Poses, Scene
from sceneloom.service.sending import sent_rig
from sceneloom.simulate import CameraSpec, LidarSpec, simulate_street
from sceneloom.view.settings import ViewSettings
from sceneloom.view.viewer import DriveView

CAMERA_MODEL = Camera("brown_conrady", 160, 96, 90.0, 90.0, 79.5, 47.5, (-0.1, 0.02, 0.0, 0.0, 0.0))
WRONG_CAMERA_MODEL = replace(CAMERA_MODEL, fx=97.0, fy=97.0)
ROTATED = RigidTransform.from_quaternion(np.array([0.3, 0.1, -0.2]), np.array([0.0, 0.05, 0.0, 0.9987492178]))
MOVED = RigidTransform.from_quaternion(np.array([40.0, -7.0, 1.5]), np.array([0.0, 0.0, 0.6, 0.8]))
LATER_NS = 3_000_000


def constant(transform):
    """The same at all times."""
    return Poses(np.zeros(1, np.int64), transform.translation[None], transform.quaternion_xyzw[None])


def with_corrections(scene, rotated, camera_model, later_ns, moved):
    camera = CameraCalibration("mounted", "camera0", constant(rotated), camera_model, later_ns)
    world = LocalizationAdjustment("placed", constant(moved))
    return replace(scene, annotations=(*scene.annotations, camera, world))


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A drive that is right, the same wrong by known corrections, and that with the annotations that repair it."""
    folder = tmp_path_factory.mktemp("corrected")
    lidar = LidarSpec(beams=16, steps=240)
    drive = simulate_street(1, frames=3, lidar=lidar, cameras=(CameraSpec(CAMERA_MODEL),))
    labels = [annotation for annotation in drive.scene.annotations if annotation.label == "car"]
    sceneloom.write(replace(drive.scene, annotations=tuple(labels[:6])), folder / "right.sfs")
    with sceneloom.open(folder / "right.sfs") as right:
        opposite = with_corrections(right, ROTATED.inverse(), WRONG_CAMERA_MODEL, -LATER_NS, MOVED.inverse())
        wrong = replace(sceneloom.apply_corrections(opposite), metadata=right.metadata, warnings=())
        sceneloom.write(wrong, folder / "wrong.sfs")
    with sceneloom.open(folder / "wrong.sfs") as wrong:
        repaired = with_corrections(wrong, ROTATED, CAMERA_MODEL, LATER_NS, MOVED)
        sceneloom.write(repaired, folder / "repaired.sfs")
    write_boxes(drive, folder)
    sceneloom.convert(folder / "right.sfs", folder / "right.tum")
    return folder


def numbers_of(value):
    """All numbers of something read from JSON, in order."""
    if isinstance(value, dict):
        for key in sorted(value):
            if key not in {"seconds", "stages", "size_bytes", "warnings"}:
                yield from numbers_of(value[key])
    elif isinstance(value, list | tuple):
        for item in value:
            yield from numbers_of(item)
    elif isinstance(value, int | float):
        yield float(value)


def figures_of_scene(path):
    """Where the camera and the cuboids are, what the camera is, when its images were taken; colours of points."""
    scene = path if isinstance(path, Scene) else sceneloom.open(path)
    found: list[Any] = []
    with scene:
        assert not scene.pending_corrections
        (camera,) = scene.cameras
        shift = np.array(scene.metadata.get("sceneloom", {}).get("world_from_file", np.eye(4)))[:3, 3]
        found += [camera.camera.fx, *(1e-6 * camera.images.timestamps_ns)]
        samples = scene.samples(reference=camera.id)
        for sample in samples:
            pose = sample.poses.world_from_sensor[camera.id]
            found += [*pose.matrix[:3, :3].ravel(), *(pose.translation + shift)]
        for annotation in scene.annotations:
            if isinstance(annotation, CuboidAnnotation):
                found += (annotation.path.values[:, 3:6] + shift).ravel().tolist()
                found += [np.nansum(part.boxes) for part in annotation.projections]
    return np.array(found, np.float64)


def colours_of(path):
    with sceneloom.open(path) as scene:
        return np.array([float(frame.points.colors.mean()) for frame in scene.lidars[0].frames])


Figures = Callable[[Callable[..., Any], Path, Path, tuple[str, ...]], Any]
"""Runs a verb of a drive, with further options, and gives numbers of what came of it."""


def ran(call, *words, codes=(0,)):
    outcome = call(*words)
    assert outcome.code in codes, outcome.err
    reported = "applied: " if "--no-corrections" not in words else "left off"
    assert reported in outcome.err + outcome.out, "it says nothing of the corrections"
    return outcome


def words_on(drive, out, words):
    lists = {name.upper(): drive.parent / f"{name}.jsonl" for name in ("boxes3d", "boxes2d")}
    known = {"DRIVE": drive, "OUT": out, "TRUTH": drive.parent / "right.tum", **lists}
    return [known.get(word, word) for word in words]


LISTS = ("--boxes3d", "BOXES3D", "--boxes2d", "BOXES2D")


def written(*words, to="out.sfs", reads=figures_of_scene):
    """Runs a verb of DRIVE that writes to OUT, and reads what it wrote."""

    def run(call, drive, out, further):
        ran(call, *words_on(drive, out / to, words), *further)
        return reads(out / to)

    return run


def reported(*words, key, codes=(0,)):
    """Runs a verb of DRIVE, and gives the numbers of what it reports to machines."""

    def run(call, drive, out, further):
        found = json.loads(ran(call, *words_on(drive, out / "out", words), "--json", *further, codes=codes).out)
        return list(numbers_of(key(found)))

    return run


def uncorrected(path, reads=figures_of_scene):
    """What is in a scene without the annotations of corrections, as it lies."""
    with sceneloom.open(path) as scene:
        left = tuple(a for a in scene.annotations if a.id not in {"mounted", "placed"})
        sceneloom.write(replace(scene, annotations=left), path.with_name("bare.sfs"))
    return reads(path.with_name("bare.sfs"))


def scene_verb(*words, reads=figures_of_scene):
    def run(call, drive, out, further):
        found = written(*words, "DRIVE", "-o", "OUT", reads=partial(uncorrected, reads=reads))
        figures = found(call, drive, out, further)
        with sceneloom.open(out / "out.sfs") as scene:
            kept = {annotation.id for annotation in scene.annotations} & {"mounted", "placed"}
        assert kept == ({"mounted", "placed"} if further else set())
        return figures

    return run


def numbers_in_text(path):
    text = path.read_text()
    if text.startswith("{"):
        return list(numbers_of(json.loads(text)))
    rows = (line.split() for line in text.splitlines() if line and not line.startswith("#"))
    return [float(word) for row in rows for word in row if word.replace(".", "").lstrip("-").isdigit()]


def depths(folder):
    return [float(sum(np.nansum(a) for a in np.load(file).values())) for file in sorted(folder.rglob("*.npz"))]


def map_colours(path):
    with sceneloom.open(path) as scene:
        (points,) = (sensor for sensor in scene.sensors if sensor.type == "points")
        return [len(points.positions) / 100, *points.colors.mean(axis=0).tolist()]


def drawn(call, drive, out, further):
    call("info", drive, "--visualize", out / "drawn", *further)
    return [float(np.asarray(Image.open(out / "drawn" / "camera_camera0.png"), np.float64).mean())]


def catalogued(call, drive, out, further):
    reading = {"corrections": "ignore"} if further else {}
    read_drive(str(drive), out, {"scene": "x", "timestamp": "", "checks": "none", "reading": reading})
    return list(numbers_of(read_draft(out, "annotations").to_pydict()))


def of_opened(figures):
    def run(call, drive, out, further):
        with sceneloom.open(drive, **({"corrections": "ignore"} if further else {})) as scene:
            return figures(scene, drive)

    return run


def sent(scene, drive):
    (entry,) = sent_rig(scene).calibrations
    return [*entry.data.extrinsic_matrix, *entry.data.intrinsic_matrix]


def checked(scene, drive):
    found = check_drive(scene, most=1)
    assert len(found.health.corrections) == 2 * (drive.name == "repaired.sfs")
    return found.frames[0].camera_from_lidar.matrix


def viewed(scene, drive):
    shown = DriveView.of(scene, "x", ViewSettings()).scene
    return figures_of_scene(replace(shown, annotations=(), on_close=lambda: None))


COMPUTING: dict[str, Figures] = {
    "fuse": scene_verb("fuse"),
    "fuse, colours": scene_verb("fuse", reads=colours_of),
    "fuse, detections": reported(
        *("fuse", "DRIVE", "--type", "detection", *LISTS, "-o", "OUT"), key=lambda found: found["drives"][0]["both"]
    ),
    "colour": written("colour", "DRIVE", "-o", "OUT", "--only-coloured", reads=map_colours),
    "depth": written("depth", "DRIVE", "-o", "OUT", *["--form", "npz", "--method", "sparse"], to="depth", reads=depths),
    "track": written("track", "DRIVE", *LISTS, "--format", "sfs", "-o", "OUT", reads=uncorrected),
    "sync": written("sync", "DRIVE", "--streams", "groundTruth", "--apply", "OUT", reads=uncorrected),
    "edit count": scene_verb("edit", "count"),
    "edit project": scene_verb("edit", "project"),
    "edit deskew": scene_verb("edit", "deskew"),
    "calibrate --check": of_opened(checked),
    "calibrate --refine": reported("calibrate", "--refine", "DRIVE", key=itemgetter("transform"), codes=(0, 3, 5)),
    "report": reported("report", "--quick", "--images", "0", "DRIVE", key=itemgetter("fusion")),
    "info --visualize": drawn,
    "eval trajectory": reported(
        *("eval", "trajectory", "DRIVE", "TRUTH", "--align", "none"),
        key=lambda found: found["absolute"]["translation"]["rms"],
    ),
    "send": of_opened(sent),
    "view": of_opened(viewed),
    "catalog build": catalogued,
    "convert to a trajectory": written(
        "convert", "DRIVE", "OUT", to="way.tum", reads=lambda path: read_trajectory(path).positions
    ),
    "convert to recording": written("convert", "DRIVE", "OUT", to="out"),
    "convert to mcap": written("convert", "DRIVE", "OUT", to="out.mcap"),
    **{
        f"convert to {name}": written("convert", "DRIVE", "OUT", "--to", name, to="out")
        for name in ("ros2", "nuscenes", "kitti-tracking")
    },
    **{
        f"convert to {name}": written(
            "convert", "DRIVE", "OUT", "--to", name, to="out", reads=lambda out, file=file: numbers_in_text(out / file)
        )
        for name, file in (("openlabel", ""), ("colmap", "sparse/0/images.txt"), ("nerfstudio", "transforms.json"))
    },
}
"""What everything that computes makes of a drive, in figures that depend on its corrections."""


@pytest.mark.few(13)
@pytest.mark.parametrize("verb", COMPUTING)
def test_a_verb_that_computes_gives_for_a_corrected_drive_what_it_gives_for_the_right_one(verb, call, files, tmp_path):
    def figures(name, *further):
        def called(*words):
            outcome = call(*words)  # of the others there is nothing to state
            return outcome if name == "repaired.sfs" else replace(outcome, err=outcome.err + "applied: left off")

        (out := tmp_path / f"{name}{len(further)}").mkdir()
        return np.asarray(COMPUTING[verb](called, files / name, out, further), np.float64)

    right, wrong = figures("right.sfs"), figures("wrong.sfs")
    assert right.shape != wrong.shape or np.nanmax(np.abs(right - wrong)) > 1e-2, "the figures state nothing"
    np.testing.assert_allclose(figures("repaired.sfs"), right, rtol=2e-3, atol=2e-3)
    np.testing.assert_allclose(figures("repaired.sfs", "--no-corrections"), wrong, rtol=2e-3, atol=2e-3)


KEEPING = frozenset(
    {
        *("info", "validate", "diff", "edit apply", "edit blur", "edit crop", "edit merge", "edit anonymise"),
        *("edit simplify", "edit thin", "edit to-ego", "edit to-sensor", "edit to-world"),
    }
)
"""Verbs that read a drive, and do not compute with where its cameras are: corrections stay what they are."""
FURTHER = frozenset(
    {"eval tracking", "eval detection", "edit undistort", "edit camera-model", "catalog update", "calibrate"}
)
"""Verbs that compute and are tested below, or under the name of one of their modes."""


def test_every_verb_that_reads_a_drive_is_known_to_apply_corrections_or_to_keep_them():
    computing = {name.split(",")[0].split(" --")[0].split(" to ")[0] for name in COMPUTING} | FURTHER
    found = {
        name
        for name, command in verbs(command_line)
        if any(parameter.name == "corrections" for parameter in command.params)
        and not name.startswith("batch ")  # the same verbs
    }
    assert found - computing - KEEPING == set(), "test them here: do they apply corrections?"
    assert (computing | KEEPING) - found == set()


@pytest.mark.parametrize("edit", ["crop", "thin", "simplify", "to-world"])
def test_an_edit_that_does_not_compute_with_cameras_keeps_corrections_and_their_meaning(
    edit, succeeds, files, tmp_path
):
    further = {"crop": ("--start", "0"), "thin": ("--voxel", "1")}.get(edit, ())
    succeeds("edit", edit, files / "repaired.sfs", "-o", tmp_path / "out.sfs", *further)
    with sceneloom.open(tmp_path / "out.sfs") as scene, sceneloom.open(files / "right.sfs") as right:
        assert {"mounted", "placed"} <= {annotation.id for annotation in scene.annotations}
        np.testing.assert_allclose(figures_of_scene(scene.corrected())[:40], figures_of_scene(right)[:40], atol=0.02)


def test_what_was_corrected_is_not_corrected_again_and_a_new_camera_model_stands_for_the_corrected_one(
    call, succeeds, files, tmp_path
):
    first, second = tmp_path / "first.sfs", tmp_path / "second.sfs"
    succeeds("fuse", files / "repaired.sfs", "-o", first)
    assert "correction" not in succeeds("fuse", first, "-o", second).err
    np.testing.assert_allclose(figures_of_scene(second), figures_of_scene(first), atol=1e-5)
    with sceneloom.open(second) as scene:
        assert [entry["id"] for entry in scene.metadata["sceneloom"]["applied"]] == ["mounted", "placed"]
    for words in (("camera-model", "--model", "fisheye", "--limit", "9"), ("undistort",)):
        found = []
        for name in ("right", "repaired"):
            succeeds("edit", *words, files / f"{name}.sfs", "-o", tmp_path / f"{name}.sfs", "--overwrite")
            with sceneloom.open(tmp_path / f"{name}.sfs") as scene:
                assert not scene.pending_corrections
                found.append(scene.cameras[0].camera)
        assert found[0] == found[1]


def test_corrections_are_listed_and_lost_where_they_are_left_off_and_not_written(call, reported, files, tmp_path):
    report = reported("info", files / "repaired.sfs")
    assert [entry["id"] for entry in report["corrections"]] == ["mounted", "placed"]
    assert "camera 'camera0'" in call("info", files / "repaired.sfs").out
    findings = json.loads(call("validate", files / "repaired.sfs", "--json").out)["findings"]
    listed = [finding["severity"] for finding in findings if finding["rule"] == "corrections-not-applied"]
    assert listed == ["hint", "hint"]
    # those that are left off and cannot be written are losses
    for to in ("recording", "mcap", "kitti-tracking", "nuscenes", "colmap", "openlabel"):
        words = ("convert", files / "repaired.sfs", tmp_path / to, "--to", to, "--no-corrections")
        lost = {row["field"] for row in reported(*words)["fields"] if row["support"] == "dropped"}
        names = {name for field in lost for name in (field, field.rpartition(".")[0])}
        assert {"annotations.camera_calibration", "annotations.localization_adjustment"} <= names, to


def test_the_library_applies_corrections_or_leaves_them_off(files):
    def figures(name, corrections="apply"):
        with sceneloom.open(files / name, corrections=corrections) as scene:
            ego = sceneloom.find_ego_motion(scene)
            fused = next(iter(sceneloom.iter_fused(scene)))
            seen = sceneloom.project_cuboids(scene)
            pose = scene.samples(reference="camera0")[1].poses.world_from_sensor["camera0"]
            boxes = [np.nansum(part.boxes) for a in seen.annotations for part in getattr(a, "projections", ())]
            colours = fused.points.colors
            return np.array([*ego.path.positions[1], *pose.matrix.ravel(), *boxes, *colours.mean(axis=0)])

    np.testing.assert_allclose(figures("repaired.sfs"), figures("right.sfs"), rtol=2e-3, atol=2e-3)
    np.testing.assert_allclose(figures("repaired.sfs", "ignore"), figures("wrong.sfs"), rtol=2e-3, atol=2e-3)
    assert np.abs(figures("right.sfs")[:19] - figures("wrong.sfs")[:19]).max() > 1.0
    with pytest.raises(sceneloom.SceneloomError, match="apply, ignore"):
        sceneloom.open(files / "repaired.sfs", corrections="twice")


@pytest.mark.parametrize("verb", ["tracking", "detection"])
def test_objects_are_compared_with_corrections_unless_they_are_left_off(verb, call, files, tmp_path):
    score = AttributePath("score", (0.9,))
    with sceneloom.open(files / "repaired.sfs") as scene:
        scored = tuple(
            replace(one, attributes=(*one.attributes, score)) if isinstance(one, CuboidAnnotation) else one
            for one in scene.annotations
        )
        sceneloom.write(replace(scene, annotations=scored), tmp_path / "found.sfs")
    words = ("eval", verb, tmp_path / "found.sfs", files / "right.sfs", "--json")
    applied, ignored = (json.loads(ran(call, *words, *further).out) for further in ((), ("--no-corrections",)))
    codes, ignored_codes = ({warning["code"] for warning in one["warnings"]} for one in (applied, ignored))
    assert any(code.startswith("correction-") for code in codes)
    assert codes != ignored_codes
    assert list(numbers_of(applied)) != list(numbers_of(ignored))
