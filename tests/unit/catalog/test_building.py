"""Building, and bringing up to date."""

import shutil

import numpy as np
import pytest

import sceneloom
from sceneloom.catalog import Selection, build, query, update
from sceneloom.catalog.layout import Layout, scene_name
from sceneloom.catalog.rows import scene_rows
from sceneloom.errors import OptionError, OutputError
from sceneloom.scene import AttributePath, EventAnnotation, Scene

from .conftest import box, street


@pytest.fixture
def copies(drives, tmp_path):
    """Drives that may be changed."""
    return sorted(shutil.copytree(drives[0].parent, tmp_path / "drives").iterdir())


def stamps(folder):
    return {file: (file.stat().st_ino, file.stat().st_mtime_ns) for file in folder.rglob("*.parquet")}


def test_an_update_touches_only_what_changed(copies, tmp_path):
    folder = tmp_path / "catalogue"
    build(copies, folder)
    before = stamps(folder)
    assert update(folder).unchanged == 3
    assert stamps(folder) == before
    sceneloom.write(street(seconds=4), copies[2], overwrite=True)
    report = update(folder)
    assert (report.changed, report.unchanged) == ((str(copies[2]),), 2)
    after = stamps(folder)
    touched = {file.parent.name for file in before if after[file] != before[file]}
    assert touched == {f"scene={scene_name(str(copies[2]), {})}"}
    assert query(folder, "SELECT count(*) FROM scenes WHERE duration > 3.8 AND duration < 4").rows == [(1,)]


def test_drives_come_and_go(copies, tmp_path):
    folder = tmp_path / "catalogue"
    build(copies[:2], folder, checks="none")
    report = update(folder, copies)
    assert (report.added, report.changed, report.unchanged) == (
        (str(copies[2]),),
        tuple(map(str, copies[:2])),
        0,
    )
    copies[0].unlink()
    assert update(folder).gone == (str(copies[0]),)
    assert update(folder).scenes == 3
    report = update(folder, prune=True)
    assert (report.removed, report.scenes) == ((str(copies[0]),), 2)
    with pytest.raises(OptionError):
        update(folder, copies, prune=True)


def test_a_drive_that_cannot_be_read_is_told_and_the_others_go_on(copies, tmp_path):
    folder = tmp_path / "catalogue"
    torn = tmp_path / "torn.sfs"
    torn.write_bytes(copies[0].read_bytes()[:200])
    report = build([torn, copies[0], tmp_path / "missing"], folder)
    assert [failure.path for failure in report.failed] == [str(torn), str(tmp_path / "missing")]
    assert (report.added, report.scenes) == ((str(copies[0]),), 1)
    copies[0].write_bytes(b"{")
    report = update(folder)
    assert [failure.path for failure in report.failed] == [str(copies[0])]
    assert query(folder, "SELECT count(*) > 0 FROM annotations").rows == [(True,)]  # what stood of it before


def test_a_scene_whose_row_is_damaged_is_told(copies, tmp_path):
    folder = tmp_path / "catalogue"
    build(copies, folder)
    next(folder.glob("scenes/*/*.parquet")).write_bytes(b"PAR1")
    report = update(folder)
    assert len(report.failed) == 1
    assert update(folder, copies).failed == ()
    assert update(folder).failed == ()


def test_nothing_else_is_replaced(copies, tmp_path):
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "precious.txt").touch()
    with pytest.raises(OutputError, match="something else"):
        build(copies, tmp_path / "own", overwrite=True)
    build(copies, tmp_path / "catalogue")
    with pytest.raises(OutputError, match="already"):
        build(copies, tmp_path / "catalogue")
    assert build(copies[:1], tmp_path / "catalogue", overwrite=True).scenes == 1
    assert [file.name for file in (tmp_path / "own").iterdir()] == ["precious.txt"]
    with pytest.raises(OptionError):
        build([], tmp_path / "none")


@pytest.mark.parametrize(
    "path", ["/a/b c.sfs", "/a/2024-01-01", "/", "s3://b/ü.sfs", "/x/'; DROP--", "/a/b\udcff"]
)
def test_names_of_scenes_mean_the_same_everywhere(path):
    name = scene_name(path, {})
    assert set(name) <= set("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_-")
    assert name.count("-") == 1
    assert name != scene_name(path, {"sequence": "2"})


@pytest.mark.parametrize("address", ["https://me:hush@host/a.sfs", "https://host/a.sfs?X-Amz-Signature=hush"])
def test_addresses_with_secrets_are_not_kept(tmp_path, address):
    with pytest.raises(OptionError, match="holds a secret") as refused:
        build([address], tmp_path / "catalogue")
    assert "hush" not in str(refused.value)
    assert not (tmp_path / "catalogue").exists()


def test_odd_scenes_are_catalogued_too(tmp_path):
    nan = float("nan")
    odd = AttributePath("size \n", (10**400, True, ("a", "b"), {"x": 1}), np.arange(4))
    boxes = (
        box("'; DROP", None, [0.0, 1.0], [[nan, 1e300, 0]] * 2, attributes=(odd,)),
        box(1, "ünï\ud800", [0.05], [[0, 0, 0]]),
        box("1", "", [], np.zeros((0, 3))),
        EventAnnotation("e", 5, label="turn"),
    )
    scene = street(seconds=2, annotations=boxes)
    tables = scene_rows(scene, path="x", options={}, fingerprint="", size_bytes=None, findings=())
    empty = scene_rows(Scene(()), path="y", options={}, fingerprint="", size_bytes=None, findings=())
    layout = Layout.made(tmp_path / "catalogue", overwrite=False)
    assert query(layout.folder, "SELECT count(*) FROM scenes JOIN annotations USING (scene)").rows == [(0,)]
    assert query(layout.folder, Selection(labels=("car",))).rows == []
    layout.write("a", tables)
    layout.write("b", empty)
    sql = "SELECT track, annotation, boxes FROM tracks ORDER BY track"
    assert query(layout.folder, sql).rows == [(0, "'; DROP", 11), (1, "1", 1), (2, "1", 0), (3, "e", 0)]
    values = query(layout.folder, "SELECT value, number FROM attributes WHERE owner = 'annotation'").rows
    assert values == [(str(10**400), None), ("true", None), ("a", None), ("b", None), ('{"x": 1}', None)]
    assert query(layout.folder, Selection(types=("cuboid",))).rows[0][3:] == (12, 1)
