"""The table of formats: which there are, which one a path is written in.

And how scenes are opened and written through it.
"""

import codecs
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from functools import cache, cached_property, partial
from itertools import islice
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar, cast
from urllib.parse import urlsplit

from sceneloom.errors import OptionError, SceneloomError, UnknownFormatError, UnknownOptionError, redacted
from sceneloom.formats.base.files import is_url, path_or_url
from sceneloom.formats.base.json_files import damage_of_json
from sceneloom.formats.base.losses import Loss, LossReport
from sceneloom.formats.base.output import Source, check_output
from sceneloom.formats.base.spec import ZIP, FormatSpec, begins, close_both, first_bytes
from sceneloom.lazy import imported
from sceneloom.scene.scene import Corrections, Scene
from sceneloom.scene.types import key_of
from sceneloom.stages import stage
from sceneloom.warnings import DataWarning, WarningKind


@dataclass(frozen=True, slots=True)
class FormatRow:
    """What a path has to be for a format to be asked whether it is its own, and where the format's spec is.

    Attributes:
        spec: `"module:name"` of a `FormatSpec`.
        file: what a file begins with (bytes), or its name ends with (text, in lower case): one of these.
        folder: what a folder has: one of these names, or patterns of names (in lower case), with `/` for what is in a
            folder of it.
    """

    spec: str
    file: tuple[bytes | str, ...] = ()
    folder: tuple[str, ...] = ()

    def fits(self, path: "_LookedAt") -> bool:
        """Whether a path may be of the format."""
        if path.is_folder:
            return any(map(path.has, self.folder))
        return any(map(path.begins_or_ends, self.file))


class _LookedAt:
    """A path as rows see it; it is looked at once for all of them."""

    def __init__(self, path: Path) -> None:
        self.path, self.is_folder = path, path.is_dir()

    @cached_property
    def _beginnings(self) -> tuple[bytes, bytes]:
        """The first bytes of a file; and without the white space that JSON may have anywhere."""
        first = first_bytes(self.path, _BEGINNING)
        return first, b"".join(first.removeprefix(codecs.BOM_UTF8).split())

    @cached_property
    def _inside(self) -> tuple[list[str], list["_LookedAt"]]:
        """Names in a folder, and the folders among these."""
        try:
            with os.scandir(self.path) as entries:
                found = [(entry.name, entry.is_dir()) for entry in entries]
        except OSError:
            found = []
        folders = [_LookedAt(self.path / name) for name, is_folder in found if is_folder]
        return [name for name, _ in found], folders

    def begins_or_ends(self, part: bytes | str) -> bool:
        """Whether a file begins with bytes, or its name ends with a text."""
        if isinstance(part, str):
            return self.path.name.lower().endswith(part)
        return any(beginning.startswith(part) for beginning in self._beginnings)

    def has(self, pattern: str) -> bool:
        """Whether a folder has something of that name."""
        name, _, rest = pattern.partition("/")
        if not _WILD.search(name):
            return (self.path / name).exists() and (not rest or _LookedAt(self.path / name).has(rest))
        names, folders = self._inside
        if not rest:
            return any(fnmatchcase(one.lower(), name) for one in names)
        return any(fnmatchcase(one.path.name.lower(), name) and one.has(rest) for one in folders)


_BEGINNING = 4096
_WILD = re.compile(r"[*?\[]")
_JSON, _MCAP = b"{", b"\x89MCAP0\r\n"
_CAPTURES = tuple(map(bytes.fromhex, ("d4c3b2a1", "a1b2c3d4", "4d3cb2a1", "a1b23c4d", "0a0d0d0a")))
_KITTI = "sceneloom.formats.kitti.spec"
_POINTS = "sceneloom.formats.points.spec"
_MESSAGES = "sceneloom.formats.messages.spec"
_LABELLING = "sceneloom.formats.labelling.spec"
_RIG_FILES = "sceneloom.formats.rig_files.spec"
_GNSS_LOGS = "sceneloom.formats.gnss_logs.spec"
_CLOUD_LABELLING = "sceneloom.formats.cloud_labelling.spec"

FORMATS: Mapping[str, FormatRow] = MappingProxyType(
    {
        "sfs": FormatRow("sceneloom.formats.sfs.spec:FORMAT", file=(_JSON,)),
        "recording": FormatRow(
            "sceneloom.formats.recording.spec:FORMAT", file=(_JSON, "data.jsonl"), folder=("data.jsonl",)
        ),
        "rig": FormatRow("sceneloom.formats.rig.spec:FORMAT", file=(".toml",), folder=("rig.toml",)),
        "mcap": FormatRow(f"{_MESSAGES}:MCAP", file=(_MCAP,)),
        "ros1": FormatRow(f"{_MESSAGES}:ROS1", file=(b"#ROSBAG V",)),
        "ros2": FormatRow(
            f"{_MESSAGES}:ROS2", file=(b"SQLite format 3\0", _MCAP), folder=("metadata.yaml", "*.db3", "*.mcap")
        ),
        "kitti-raw": FormatRow(
            f"{_KITTI}:RAW",
            folder=(*("velodyne_points", "oxts/data", "image_0[0-3]"), *("*_drive_*", "????_??_??/*_drive_*")),
        ),
        "kitti-object": FormatRow(f"{_KITTI}:OBJECT", folder=("calib", "training/calib", "testing/calib")),
        "kitti-tracking": FormatRow(f"{_KITTI}:TRACKING", folder=("calib", "training/calib", "testing/calib")),
        "kitti-odometry": FormatRow(
            f"{_KITTI}:ODOMETRY",
            folder=("calib.txt", "times.txt", "sequences", "[0-9][0-9]/calib.txt", "[0-9][0-9]/times.txt"),
        ),
        "kitti-360": FormatRow(f"{_KITTI}:KITTI_360", folder=("data_2d_raw", "data_3d_raw", "data_poses")),
        "nuscenes": FormatRow(
            "sceneloom.formats.nuscenes.spec:FORMAT",
            folder=(
                *("sample_data.json", "ego_pose.json", "calibrated_sensor.json", "v[0-9]*"),
                *("annotation/*.json", "[0-9]*/annotation/*.json"),
            ),
        ),
        "ncore": FormatRow(
            "sceneloom.formats.ncore.spec:FORMAT",
            file=(".zarr.itar", b'{"sequence_id":'),
            folder=(".zattrs", "*.zarr.itar", "*.zarr"),
        ),
        "argoverse2": FormatRow(
            "sceneloom.formats.argoverse2.spec:FORMAT",
            folder=(
                *("city_SE3_egovehicle.feather", "calibration/egovehicle_SE3_sensor.feather"),
                *("*/city_SE3_egovehicle.feather", "*/calibration/egovehicle_SE3_sensor.feather"),
            ),
        ),
        "pandaset": FormatRow(
            "sceneloom.formats.pandaset.spec:FORMAT",
            folder=("lidar", "annotations/cuboids", "*/lidar", "*/annotations/cuboids"),
        ),
        "waymo": FormatRow(
            "sceneloom.formats.waymo.spec:FORMAT",
            folder=("vehicle_pose/*.parquet", "lidar/*.parquet", "camera_image/*.parquet"),
        ),
        "zod": FormatRow(
            "sceneloom.formats.zod.spec:FORMAT",
            folder=("calibration.json", "lidar_velodyne", "*/calibration.json", "*/lidar_velodyne"),
        ),
        "scale-toolkit": FormatRow("sceneloom.formats.scale_toolkit.spec:FORMAT", folder=("pointcloud",)),
        "supervisely": FormatRow(f"{_CLOUD_LABELLING}:SUPERVISELY", folder=("meta.json", "annotation.json", "ann")),
        "segments": FormatRow(f"{_CLOUD_LABELLING}:SEGMENTS", file=(".json",), folder=("*.json",)),
        "scale-task": FormatRow(f"{_CLOUD_LABELLING}:SCALE_TASK", folder=("frames",)),
        "sustechpoints": FormatRow(f"{_CLOUD_LABELLING}:SUSTECHPOINTS", folder=("lidar", "*/lidar")),
        "pcd": FormatRow(f"{_POINTS}:PCD", file=(".pcd",), folder=("*.pcd", "*/*.pcd")),
        "ply": FormatRow(f"{_POINTS}:PLY", file=(".ply",), folder=("*.ply", "*/*.ply")),
        "las": FormatRow(f"{_POINTS}:LAS", file=(".las",), folder=("*.las", "*/*.las")),
        "laz": FormatRow(f"{_POINTS}:LAZ", file=(".laz",), folder=("*.laz", "*/*.laz")),
        "kitti-bin": FormatRow(f"{_POINTS}:KITTI_BIN", file=(".bin",), folder=("*.bin", "*/*.bin")),
        "nuscenes-bin": FormatRow(f"{_POINTS}:NUSCENES_BIN", file=(".pcd.bin",), folder=("*.pcd.bin", "*/*.pcd.bin")),
        "npz": FormatRow(f"{_POINTS}:NPZ", file=(".npz", ".npy"), folder=("*.npz", "*.npy", "*/*.npz", "*/*.npy")),
        "pcap": FormatRow("sceneloom.formats.packets.spec:FORMAT", file=_CAPTURES),
        "lvx": FormatRow("sceneloom.formats.packets.spec:LVX", file=(b"livox_tech\0",)),
        "euroc-mav": FormatRow(
            "sceneloom.formats.euroc_mav.spec:FORMAT", folder=("mav0", "cam[01]/data.csv", "imu[01]/data.csv")
        ),
        "nmea": FormatRow(f"{_GNSS_LOGS}:NMEA", file=(b"$", ".nmea", ".gga", ".log", ".txt", ".ubx")),
        "ubx": FormatRow(
            f"{_GNSS_LOGS}:UBX", file=(b"\xb5\x62", b"$", ".ubx", ".nmea", ".log", ".txt", ".dat", ".raw")
        ),
        "rtklib": FormatRow(f"{_GNSS_LOGS}:RTKLIB", file=(b"%", ".pos", ".txt")),
        "openlabel": FormatRow("sceneloom.formats.openlabel.spec:FORMAT", file=(b'{"openlabel":',)),
        "cvat": FormatRow(f"{_LABELLING}:CVAT", file=(".xml",), folder=("*.xml",)),
        "tracklets": FormatRow(f"{_LABELLING}:TRACKLETS", file=(".xml",), folder=("frame_list.txt",)),
        "coco": FormatRow(f"{_LABELLING}:COCO", file=(".json",), folder=("*.json", "annotations/*.json")),
        "datumaro": FormatRow(f"{_LABELLING}:DATUMARO", file=(".json",), folder=("*.json", "annotations/*.json")),
        "yolo": FormatRow(
            f"{_LABELLING}:YOLO",
            file=(".yaml", ".yml", "obj.names", "obj.data"),
            folder=("data.yaml", "data.yml", "dataset.yaml", "obj.names", "obj.data"),
        ),
        "label-studio": FormatRow(f"{_LABELLING}:LABEL_STUDIO", file=(b"[{",), folder=("tasks.json",)),
        "colmap": FormatRow("sceneloom.formats.posed_images.spec:COLMAP"),
        "nerfstudio": FormatRow("sceneloom.formats.posed_images.spec:NERFSTUDIO"),
        "urdf": FormatRow(f"{_RIG_FILES}:URDF"),
        "kalibr": FormatRow(f"{_RIG_FILES}:KALIBR"),
        "camera-info": FormatRow(f"{_RIG_FILES}:CAMERA_INFO"),
    }
)
"""The formats by name. Their rows are looked at before a spec is imported; they only rule out, and a spec decides."""


@cache
def _entry_points() -> tuple[Any, ...]:
    """The formats that other packages add: looked for once, and not before it is needed, since that takes a while."""
    from importlib.metadata import entry_points

    return tuple(point for point in entry_points(group="sceneloom.formats") if point.name not in FORMATS)


def format_names() -> list[str]:
    """Names of all formats, ours first, then those that other packages add."""
    return [*FORMATS, *(point.name for point in _entry_points())]


def format_named(name: str) -> FormatSpec:
    """Import the spec of one format.

    Raises:
        OptionError: there is none of that name.
    """
    if name in FORMATS:
        return cast("FormatSpec", imported(FORMATS[name].spec))
    for point in _entry_points():
        if point.name == name:
            return cast("FormatSpec", point.load())
    raise OptionError(f"no format {name!r}; there are {', '.join(format_names())}")


def _all_formats() -> list[FormatSpec]:
    """Import the specs of all formats."""
    return list(map(format_named, format_names()))


def written_formats() -> list[str]:
    """Names of the formats that are written."""
    return [form.name for form in _all_formats() if form.writes]


def formats_that_may_be(path: Path) -> list[FormatSpec]:
    """The formats whose rows an existing path fits; those of other packages have none, and are always asked."""
    looked_at = _LookedAt(path)
    names = [name for name in format_names() if name not in FORMATS or FORMATS[name].fits(looked_at)]
    return [form for form in map(format_named, names) if form.reads]


def claims_of(path: Path) -> list[FormatSpec]:
    """The formats whose content test accepts an existing path."""
    return [form for form in formats_that_may_be(path) if form.sniff(path)]


def find_format(path: Path) -> FormatSpec:
    """Find the format whose content test accepts an existing path, or what a zip archive holds.

    Raises:
        UnknownFormatError: the path is missing, or none, or more than one format claims it.
        DataError: it is a zip archive that cannot be unpacked.
    """
    if not path.exists():
        raise UnknownFormatError(path, "", "no such file or folder")
    claims = claims_of(path)
    guess: Callable[[], list[str]] = partial(_guesses, path)
    if not claims and begins(path, ZIP):
        claims, guess = _looked_into(path)
    if len(claims) == 1:
        return claims[0]
    if not claims:
        expected = f"expected one of: {', '.join(form.name for form in _all_formats() if form.reads)}"
        raise UnknownFormatError(path, "", "; ".join(["no reader knows this", *guess(), expected]))
    names = "; ".join(f"{form.name}, {form.looks_like}" for form in claims)
    raise UnknownFormatError(
        path,
        "",
        f"more than one reader claims this: {names}; choose one (`--input-format {claims[0].name}`, "
        "format= in Python), or take them apart into folders of their own",
    )


def _looked_into(path: Path) -> tuple[list[FormatSpec], Callable[[], list[str]]]:
    """What claims the drive in a zip archive, and what guesses why nothing does."""
    from sceneloom.formats.base.zipped import look_into

    unpacked = look_into(path)
    locations = list(unpacked.locations())
    claims = next(filter(None, map(claims_of, locations)), [])

    def guesses() -> list[str]:
        near = [guess.replace(str(unpacked.folder), path.name) for guess in _guesses(locations[-1])]
        return [*near, f"it is a zip archive: unpack what is wanted of it first (`unzip {path.name} -d FOLDER`)"]

    return claims, guesses


def _guesses(path: Path) -> list[str]:
    """What a person may have meant: what nearly is of a format, and what lies right inside of a folder."""
    if _is_empty(path):
        return ["it is empty"]
    damaged = [damage for file in _json_files(path) if (damage := damage_of_json(file))]
    if damaged:
        return damaged
    near = {form.name: form.near_miss(path) for form in map(format_named, FORMATS) if form.reads}
    reported = [f"{name}? {guess}" for name, guess in near.items() if guess]
    return reported or _inside(path)


def _json_files(path: Path) -> list[Path]:
    """The files of JSON that a path is, or that are in a folder where labelling tools put them."""
    if not path.is_dir():
        return [path] if first_bytes(path, _BEGINNING).lstrip()[:1] in (b"{", b"[") else []
    try:
        return list(islice((one for name in _OF_LABELS for one in sorted(path.glob(name))), _LOOKED_AT))
    except OSError:
        return []


_OF_LABELS = ("*.json", "annotations/*.json")


def _is_empty(path: Path) -> bool:
    try:
        return not any(path.iterdir()) if path.is_dir() else path.stat().st_size == 0
    except OSError:
        return False


def _inside(path: Path) -> list[str]:
    """Folders and scene files one level below a folder that is none itself."""
    if not path.is_dir():
        return []
    try:
        below = sorted(entry for entry in path.iterdir() if not entry.name.startswith("."))[:_LOOKED_AT]
        found = [(entry, form.name) for entry in below for form in claims_of(entry)]
    except OSError:
        return []
    if not found:
        return []
    more = f" and {len(found) - 3} more" if len(found) > 3 else ""
    return ["inside are " + ", ".join(f"{entry} ({name})" for entry, name in found[:3]) + more]


_LOOKED_AT = 20  # how many entries of an unknown folder are looked into


def _format_of_url(url: str) -> FormatSpec:
    """Find the format that reads files behind URLs; those of another suffix have to be fetched first."""
    suffix = Path(urlsplit(url).path).suffix.lower()
    forms = [form for form in _all_formats() if form.reads_urls]
    for form in forms:
        if suffix in form.suffixes:
            return form
    if len(forms) == 1 and not suffix:
        return forms[0]
    known = ", ".join(suffix for form in forms for suffix in form.suffixes)
    raise UnknownFormatError(url, "", f"expected a URL that ends in {known}; fetch other files first")


PART = ("start", "stop")
"""Options of `open_scene` that name a part of a drive."""


def open_scene(
    path: str | Path,
    *,
    format: str | None = None,
    start: float | None = None,
    stop: float | None = None,
    corrections: str = Corrections.APPLY,
    **options: Any,
) -> Scene:
    """Open a recording or a scene file lazily.

    ```python
    with sceneloom.open("2011_09_26/2011_09_26_drive_0001_sync") as scene:
        print(scene)  # five lines: sensors, trajectories, annotations
        for sample in scene.samples():
            print(sample.timestamp_ns, len(sample.sweep.points), list(sample.images))
    ```

    Formats: sfs, recording, rig, mcap, ros1, ros2, kitti-raw, kitti-object, kitti-tracking, kitti-odometry,
    kitti-360, nuscenes, argoverse2, pandaset, ncore, waymo, zod, scale-toolkit, supervisely, segments, scale-task,
    sustechpoints, euroc-mav, openlabel, cvat, tracklets, coco, datumaro, yolo, label-studio, nmea, ubx, rtklib, pcap,
    lvx; clouds as pcd, ply, las, laz, kitti-bin, nuscenes-bin, npz. `sceneloom formats` describes each.

    Args:
        path: a file or folder, a zip archive of one, or the URL of one (needs the extra `cloud`): scene files and MCAP
            files are read by ranges, files of folders fetched when they are opened, and other files at once. What is
            fetched or unpacked is in a temporary folder, which is removed when the scene is closed.
        format: the format's name, where the content should not decide.
        start, stop: seconds after the scene's first timestamp between which it counts, as of `editing.crop_scene`;
            None for the beginning and the end.
        corrections: "apply" or "ignore": what is done with the scene's camera calibrations and localization adjustments
            by everything that computes with it (`Scene.corrected`). Here they stay as they are.
        options: reading options of the format, such as `lenient=True`, which skips what is broken, counts it, and goes
            on; one that the format does not have is named in the error, with those that it has. Of every format: `rig`,
            a file or several that state mountings and camera models which the drive does not (URDF, Kalibr, OpenCV,
            camera_info, …), and `rig_names`, what these call a sensor, by its id, or `"ego"`.

    Raises:
        UnknownFormatError: no format fits the path.
        DataError: the content is wrong.
        OptionError: there is nothing between `start` and `stop`, or `corrections` is none of these.
    """
    chosen = chosen_corrections(corrections)
    scene = part_of(_whole_scene(path, format, options), start=start, stop=stop)
    return scene if scene.corrections is chosen else replace(scene, corrections=chosen)


def chosen_corrections(stated: str) -> Corrections:
    """What is done with corrections, by its name.

    Raises:
        OptionError: there is no such choice.
    """
    try:
        return Corrections(stated)
    except ValueError as error:
        raise OptionError(f"corrections {stated!r}; expected one of {', '.join(Corrections)}") from error


def scene_for(form: FormatSpec, scene: Scene) -> Scene:
    """Give the scene that a format is to write: with its corrections applied where the format has no field for them."""
    return scene if form.holds_corrections else scene.corrected()


def write_in(form: FormatSpec, scene: Scene, path: Path, **options: Any) -> LossReport:
    """Write a scene in a format; corrections that it cannot hold are applied, or lost where they are to be left off.

    Raises:
        OutputError: the output exists, or cannot be written.
    """
    written = scene_for(form, scene)
    lost = () if form.holds_corrections else written.pending_corrections
    if not lost:
        return form.write(written, path, **options)
    keys = {key_of(annotation.id) for annotation in lost}
    left = tuple(annotation for annotation in written.annotations if key_of(annotation.id) not in keys)
    losses = [
        Loss(field=f"annotations.{correction.type}", what="left out: not applied, and the format has no field for it")
        for correction in lost
    ]
    return LossReport.of([*form.write(replace(written, annotations=left), path, **options), *losses])


def part_of(scene: Scene, *, start: float | None = None, stop: float | None = None) -> Scene:
    """Give the part of a scene that was asked for on opening it; where there is none, it is closed.

    Raises:
        OptionError: there is nothing between `start` and `stop`.
    """
    if start is None and stop is None:
        return scene
    from sceneloom.editing.crop import crop_scene

    try:
        return crop_scene(scene, start=start, stop=stop)
    except BaseException:
        scene.close()
        raise


def _whole_scene(path: str | Path, format: str | None, options: dict[str, Any]) -> Scene:
    where = path_or_url(path)
    if isinstance(where, str) and not _read_by_ranges(where, format):
        return _fetched_scene(where, format, options)
    with stage("opening"):
        form, location = format_and_location(path, format=format)
        return opened_by(form, location, **options)


def opened_by(form: FormatSpec, location: Path | str, **options: Any) -> Scene:
    """Open a scene with its format; until it is closed, no output replaces what it is read from."""
    scene = form.open(location, **options)
    if isinstance(location, str):
        return scene
    return replace(scene, on_close=partial(close_both, scene.on_close, Source(location).release))


def _read_by_ranges(url: str, format: str | None) -> bool:
    if format is not None:
        return format_named(format).reads_urls
    suffix = Path(urlsplit(url).path).suffix.lower()
    return any(form.reads_urls and suffix in form.suffixes for form in _all_formats())


_FETCH = "sceneloom.formats.remote.mirror:fetch"
_UPLOADING = "sceneloom.formats.remote.uploads:uploading"
"""What brings files from URLs and to URLs; imported where one is given."""


def _fetched_scene(url: str, format: str | None, options: dict[str, Any]) -> Scene:
    """Open a file that is fetched, or a folder whose files are when they are read; they go when the scene is closed."""
    with stage("fetching"):
        fetched = imported(_FETCH)(url)
    try:
        scene = open_scene(fetched.path, format=format, **options)
    except BaseException as error:
        fetched.remove()
        if isinstance(error, SceneloomError):
            error.rename(str(fetched.path), url.rstrip("/"))
        raise
    reported = DataWarning(kind=WarningKind.ASSUMED, code="fetched", location=redacted(url), message=fetched.reported())
    return replace(
        scene,
        source=redacted(url),
        warnings=(*scene.warnings, reported),
        on_close=partial(close_both, scene.on_close, fetched.remove),
    )


def format_and_location(path: str | Path, *, format: str | None = None) -> tuple[FormatSpec, Any]:
    """Find the format of a path or URL, and what it opens: a `Path`, or the URL as text.

    Raises:
        UnknownFormatError: no format fits the path.
        OptionError: the format is not read from URLs.
    """
    where = path_or_url(path)
    if not isinstance(where, str):
        return find_format(where) if format is None else format_named(format), where
    form = _format_of_url(where) if format is None else format_named(format)
    if not form.reads_urls:
        raise OptionError(f"{where}: the format {form.name} is not read from URLs; fetch the files first")
    return form, where


def format_for_output(path: Path) -> FormatSpec:
    """Find the format that a path to be written asks for: its suffix; a path without one is a recording folder.

    Raises:
        OptionError: no format, or more than one, that is written has that suffix.
    """
    if not path.suffix:
        return format_named(_OF_FOLDERS)
    endings = [
        (suffix, form)
        for form in _all_formats()
        if form.writes
        for suffix in form.suffixes
        if suffix and path.name.lower().endswith(suffix)
    ]
    longest = max((len(suffix) for suffix, _ in endings), default=0)
    found = [form for suffix, form in endings if len(suffix) == longest]
    if len(found) == 1:
        return found[0]
    if found:
        names = " or ".join(f"`--to {form.name}`" for form in found)
        raise OptionError(f"{path}: suffix {path.suffix!r} belongs to several formats; use {names}")
    known = ", ".join(
        f"{name} ({' '.join(s or 'folder' for s in format_named(name).suffixes)})" for name in written_formats()
    )
    raise OptionError(
        f"{path}: suffix {path.suffix!r} belongs to no format; expected one of: {known}, or name it with `--to`"
    )


_OF_FOLDERS = "recording"  # what a folder that is to be written becomes where nothing else is stated


def check_scene_output(path: Path, *, overwrite: bool) -> None:
    """Refuse a location that a scene cannot be written to, before much is done.

    Raises:
        OutputError: it exists, or is one where an output of its format would do harm.
        OptionError: no format has its suffix.
    """
    form = format_for_output(path)
    check_output(path, overwrite=overwrite)
    form.check_output(path)


def write_scene(
    scene: Scene, path: str | Path, *, format: str | None = None, overwrite: bool = False, **options: Any
) -> LossReport:
    """Write a scene in the format that the path's suffix, or `format`, names; a URL of a store may stand for the path.

    Where the format has no field for corrections, they are applied (`Scene.corrected`). Each format's own function
    takes the same scene, path and `overwrite`, replaces nothing but a file or folder of its format, and reports what
    that could not hold.

    Raises:
        OutputError: the output exists, or cannot be written.
        OptionError: no format has that suffix or name.
        DataError: what the scene is read from is damaged.
    """
    if is_url(path):
        with imported(_UPLOADING)(str(path), overwrite=overwrite) as draft:
            return write_scene(scene, draft, format=format, **options)
    where = Path(path)
    form = format_for_output(where) if format is None else format_named(format)
    return write_in(form, scene, where, overwrite=overwrite, **options)


_Read = TypeVar("_Read")


@dataclass(slots=True)
class SharedOptions:
    """Reading options of several drives.

    Attributes:
        options: by name.
    """

    options: Mapping[str, Any]
    _taken: set[str] = field(default_factory=set)
    _refused: dict[str, UnknownOptionError] = field(default_factory=dict)

    def read(self, reader: Callable[..., _Read]) -> _Read:
        """Call what reads a drive, with those of the options that it takes."""
        left = dict(self.options)
        while True:
            try:
                found = reader(**left)
            except UnknownOptionError as error:
                if error.option not in left:
                    raise
                self._refused[error.option] = error
                del left[error.option]
            else:
                self._taken.update(left)
                return found

    def check(self) -> None:
        """Refuse an option that no drive took.

        Raises:
            UnknownOptionError: there is one.
        """
        for name, error in self._refused.items():
            if name not in self._taken:
                raise error


@contextmanager
def open_scenes(paths: Sequence[str | Path], options: Mapping[str, Any]) -> Iterator[list[Scene]]:
    """Open several drives, as `open_scene` opens one, and close them all.

    Args:
        paths: files, folders or URLs.
        options: of reading; each for the drives whose format takes it.

    Raises:
        UnknownOptionError: none of them takes an option.
        SceneloomError: one cannot be opened.
    """
    shared = SharedOptions(options)
    with ExitStack() as stack:
        scenes = [stack.enter_context(shared.read(partial(open_scene, path))) for path in paths]
        shared.check()
        yield scenes


def drives_of(path: Path, *, read_as: str | None = None) -> Sequence[Path | str]:
    """Name the drives of a data set that has several.

    Args:
        path: a folder, or any other path.
        read_as: name of its format, where its content shall not decide.

    Returns:
        of each its own folder, or the name that the option `sequence` of its format takes. Empty where the path is one
        drive, or not known as a data set; opening it reports more.
    """
    if not path.is_dir():
        return ()
    forms = formats_that_may_be(path) if read_as is None else [format_named(read_as)]
    sets = [form.drives for form in forms if form.drives is not None and form.sniff(path)]
    if len(sets) != 1:
        return ()
    try:
        found = sets[0](path)
    except SceneloomError:
        return ()
    return found if len(found) > 1 else ()
