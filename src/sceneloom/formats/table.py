"""Which formats there are, and which of them a path is written in."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache, partial
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol, cast
from urllib.parse import urlsplit

from sceneloom.errors import OptionError, SceneloomError, UnknownFormatError
from sceneloom.formats.loss import Holding, Loss, LossReport
from sceneloom.formats.output import Source, check_output
from sceneloom.formats.urls import is_url, path_or_url
from sceneloom.redaction import redacted
from sceneloom.scene.notices import Notice, NoticeKind
from sceneloom.scene.scene import Corrections, Scene
from sceneloom.scene.types import key_of
from sceneloom.stages import stage

FORMATS: Mapping[str, str] = MappingProxyType(
    {
        "sfs": "sceneloom.formats.sfs.form:FORMAT",
        "recording": "sceneloom.formats.recording.form:FORMAT",
        "rig": "sceneloom.formats.rig.form:FORMAT",
        "mcap": "sceneloom.formats.mcap.form:FORMAT",
        "ros1": "sceneloom.formats.ros.form:ROS1",
        "ros2": "sceneloom.formats.ros.form:ROS2",
        "kitti-raw": "sceneloom.formats.kitti.raw.form:FORMAT",
        "kitti-object": "sceneloom.formats.kitti.object.form:FORMAT",
        "kitti-tracking": "sceneloom.formats.kitti.tracking.form:FORMAT",
        "kitti-odometry": "sceneloom.formats.kitti.odometry.form:FORMAT",
        "nuscenes": "sceneloom.formats.nuscenes.form:FORMAT",
        "argoverse2": "sceneloom.formats.argoverse2.form:FORMAT",
        "pandaset": "sceneloom.formats.pandaset.form:FORMAT",
        "scale-toolkit": "sceneloom.formats.scale_toolkit.form:FORMAT",
        "pcd": "sceneloom.formats.clouds.form:PCD",
        "ply": "sceneloom.formats.clouds.form:PLY",
        "las": "sceneloom.formats.clouds.form:LAS",
        "laz": "sceneloom.formats.clouds.form:LAZ",
        "kitti-bin": "sceneloom.formats.clouds.form:KITTI_BIN",
        "nuscenes-bin": "sceneloom.formats.clouds.form:NUSCENES_BIN",
        "npz": "sceneloom.formats.clouds.form:NPZ",
        "euroc-mav": "sceneloom.formats.euroc_mav.form:FORMAT",
        "openlabel": "sceneloom.formats.openlabel.form:FORMAT",
        "colmap": "sceneloom.formats.colmap.form:FORMAT",
        "nerfstudio": "sceneloom.formats.nerfstudio.form:FORMAT",
    }
)
"""Name of each format and the `module:object` that implements it."""


class Format(Protocol):
    """What a format module offers as `FORMAT`.

    Further attributes are optional: `reads` and `writes`, false where it is only written or only read; `reads_urls`;
    `near_miss(path)`, what a path that nearly is one lacks; `drives`, as of `FolderFormat`; `check_place(path)`, which
    refuses harmful outputs; `holds_corrections`, true where corrections are written as annotations;
    `along_trajectory`, true where `write` takes the name of the ego's way as `trajectory`.
    """

    name: str
    suffixes: tuple[str, ...]
    looks_like: str
    """What a person recognises it by ("a file that begins with its header")."""
    holds: Mapping[str, Holding]
    """What becomes of each field of a scene that is written, whatever the scene, by names of `MODEL_FIELDS` or
    beginnings of them; what depends on the scene is told by the losses of `write`. Empty where it is only read."""

    def recognises(self, path: Path) -> bool:
        """Say whether the content of an existing path looks like this format."""
        ...

    def open(self, path: Any, **options: Any) -> Scene:
        """Open a path lazily, or a URL as text if the format has a true `reads_urls`; the scene owns its files."""
        ...

    def write(self, scene: Scene, path: Path, *, overwrite: bool = False, **options: Any) -> LossReport:
        """Write beside the target, then rename; say what the format could not hold."""
        ...


@cache
def _entry_points() -> tuple[Any, ...]:
    """The formats that other packages add: looked for once, and not before it is needed, since that takes a while."""
    from importlib.metadata import entry_points

    return tuple(point for point in entry_points(group="sceneloom.formats") if point.name not in FORMATS)


def format_names() -> list[str]:
    """Names of all formats, ours first, then those that other packages add."""
    return [*FORMATS, *(point.name for point in _entry_points())]


def format_named(name: str) -> Format:
    """Import one format.

    Raises:
        OptionError: there is none of that name.
    """
    if name in FORMATS:
        module, attribute = FORMATS[name].split(":")
        return cast("Format", getattr(import_module(module), attribute))
    for point in _entry_points():
        if point.name == name:
            return cast("Format", point.load())
    raise OptionError(f"no format {name!r}; there are {', '.join(format_names())}")


def reads(form: Format) -> bool:
    """Whether a format is read."""
    return bool(getattr(form, "reads", True))


def writes(form: Format) -> bool:
    """Whether a format is written."""
    return bool(getattr(form, "writes", True))


def written_formats() -> list[str]:
    """Names of the formats that are written."""
    return [name for name in format_names() if writes(format_named(name))]


def claims_of(path: Path) -> list[Format]:
    """The formats whose content test accepts an existing path."""
    return [form for form in map(format_named, format_names()) if reads(form) and form.recognises(path)]


def find_format(path: Path) -> Format:
    """Find the format whose content test accepts an existing path.

    Raises:
        UnknownFormatError: the path is missing, or none, or more than one format claims it.
    """
    if not path.exists():
        raise UnknownFormatError(path, "", "no such file or folder")
    claims = claims_of(path)
    if len(claims) == 1:
        return claims[0]
    if not claims:
        raise UnknownFormatError(path, "", "; ".join(["no reader knows this", *_guesses(path), _known()]))
    names = "; ".join(f"{form.name}, {form.looks_like}" for form in claims)
    raise UnknownFormatError(
        path,
        "",
        f"more than one reader claims this: {names}; say which it is (`--read-as {claims[0].name}`, "
        "format= in Python), or take them apart into folders of their own",
    )


def _guesses(path: Path) -> list[str]:
    """What a person may have meant: what nearly is of a format, and what lies right inside of a folder."""
    if _is_empty(path):
        return ["it is empty"]
    near = {form.name: _near_miss(form, path) for form in map(format_named, FORMATS) if reads(form)}
    told = [f"{name}? {guess}" for name, guess in near.items() if guess]
    return told or _inside(path)


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


_LOOKED_AT = 20
"""How many entries of an unknown folder are looked into."""


def _known() -> str:
    return f"expected one of: {', '.join(name for name in format_names() if reads(format_named(name)))}"


def _near_miss(form: Format, path: Path) -> str | None:
    """What keeps a path from being of a format, where the format can tell."""
    told = getattr(form, "near_miss", None)
    return None if told is None else cast("str | None", told(path))


def _format_of_url(url: str) -> Format:
    """Find the format that reads files behind URLs; those of another suffix have to be fetched first.

    Raises:
        UnknownFormatError: no format reads such a URL.
    """
    suffix = Path(urlsplit(url).path).suffix.lower()
    forms = [form for form in map(format_named, format_names()) if getattr(form, "reads_urls", False)]
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

    Args:
        path: a file or folder, or the URL of one (needs the extra `cloud`): scene files and MCAP files are read by
            ranges, files of folders fetched when they are opened, and other files at once, into a temporary folder,
            which is removed when the scene is closed.
        format: the format's name, where the content should not decide.
        start, stop: seconds after the scene's first time stamp between which it counts, as of `editing.crop_scene`;
            None for the beginning and the end.
        corrections: "apply" or "ignore": what is done with the scene's camera calibrations and localization adjustments
            by everything that computes with it (`Scene.corrected`). Here they stay as they are.
        options: reading options of the format.

    Raises:
        UnknownFormatError: no format fits the path.
        DataError: the content is wrong.
        OptionError: there is nothing between `start` and `stop`, or `corrections` is none of these.
    """
    chosen = chosen_corrections(corrections)
    scene = part_of(_whole_scene(path, format, options), start=start, stop=stop)
    return scene if scene.corrections is chosen else replace(scene, corrections=chosen)


def chosen_corrections(said: str) -> Corrections:
    """What is done with corrections, by its name.

    Raises:
        OptionError: there is no such choice.
    """
    try:
        return Corrections(said)
    except ValueError as error:
        raise OptionError(f"corrections {said!r}; expected one of {', '.join(Corrections)}") from error


def scene_for(form: Format, scene: Scene) -> Scene:
    """Give the scene that a format is to write: with its corrections applied where the format has no place for them."""
    return scene if getattr(form, "holds_corrections", False) else scene.corrected()


def write_in(form: Format, scene: Scene, path: Path, **options: Any) -> LossReport:
    """Write a scene in a format; corrections that it cannot hold are applied, or lost where they are to be left off.

    Raises:
        OutputError: the output exists, or cannot be written.
    """
    written = scene_for(form, scene)
    lost = () if getattr(form, "holds_corrections", False) else written.pending_corrections
    if not lost:
        return form.write(written, path, **options)
    keys = {key_of(annotation.id) for annotation in lost}
    left = tuple(annotation for annotation in written.annotations if key_of(annotation.id) not in keys)
    losses = [
        Loss(
            field=f"annotations.{correction.type}",
            what="left out: not applied, and the format has no place for it",
        )
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
        form, place = format_and_place(path, format=format)
        return opened_by(form, place, **options)


def opened_by(form: Format, place: Path | str, **options: Any) -> Scene:
    """Open a scene with its format; until it is closed, no output replaces what it is read from."""
    scene = form.open(place, **options)
    if isinstance(place, str):
        return scene
    return replace(scene, on_close=partial(_close_both, scene.on_close, Source(place).release))


def _read_by_ranges(url: str, format: str | None) -> bool:
    if format is not None:
        return bool(getattr(format_named(format), "reads_urls", False))
    suffix = Path(urlsplit(url).path).suffix.lower()
    return any(
        suffix in form.suffixes
        for form in map(format_named, format_names())
        if getattr(form, "reads_urls", False)
    )


def _fetched_scene(url: str, format: str | None, options: dict[str, Any]) -> Scene:
    """Open a file that is fetched, or a folder whose files are when they are read; they go when the scene is closed."""
    from sceneloom.formats.remote.fetching import fetch

    with stage("fetching"):
        fetched = fetch(url)
    try:
        scene = open_scene(fetched.path, format=format, **options)
    except BaseException as error:
        fetched.remove()
        if isinstance(error, SceneloomError):
            error.rename(str(fetched.path), url.rstrip("/"))
        raise
    told = Notice(
        kind=NoticeKind.ASSUMED,
        code="fetched",
        place=redacted(url),
        message=fetched.told(),
    )
    return replace(
        scene,
        source=redacted(url),
        notices=(*scene.notices, told),
        on_close=partial(_close_both, scene.on_close, fetched.remove),
    )


def _close_both(close: Callable[[], None], remove: Callable[[], None]) -> None:
    close()
    remove()


def format_and_place(path: str | Path, *, format: str | None = None) -> tuple[Format, Any]:
    """Find the format of a path or URL, and what it opens: a `Path`, or the URL as text.

    Raises:
        UnknownFormatError: no format fits the path.
        OptionError: the format is not read from URLs.
    """
    where = path_or_url(path)
    if not isinstance(where, str):
        return find_format(where) if format is None else format_named(format), where
    form = _format_of_url(where) if format is None else format_named(format)
    if not getattr(form, "reads_urls", False):
        raise OptionError(f"{where}: the format {form.name} is not read from URLs; fetch the files first")
    return form, where


def format_for_output(path: Path) -> Format:
    """Find the format that a path to be written asks for: its suffix; a path without one is a recording folder.

    Raises:
        OptionError: no format, or more than one, that is written has that suffix.
    """
    if not path.suffix:
        return format_named(_OF_FOLDERS)
    endings = [
        (suffix, form)
        for form in map(format_named, written_formats())
        for suffix in form.suffixes
        if suffix and path.name.lower().endswith(suffix)
    ]
    longest = max((len(suffix) for suffix, _ in endings), default=0)
    found = [form for suffix, form in endings if len(suffix) == longest]
    if len(found) == 1:
        return found[0]
    if found:
        names = " or ".join(f"`--to {form.name}`" for form in found)
        raise OptionError(f"{path}: suffix {path.suffix!r} belongs to several formats; say {names}")
    known = ", ".join(
        f"{name} ({' '.join(s or 'folder' for s in format_named(name).suffixes)})"
        for name in written_formats()
    )
    raise OptionError(
        f"{path}: suffix {path.suffix!r} belongs to no format; expected one of: {known}, or name it with `--to`"
    )


_OF_FOLDERS = "recording"
"""What a folder that is to be written becomes where nothing else is said."""


def check_scene_output(path: Path, *, overwrite: bool) -> None:
    """Refuse a place that a scene cannot be written to, before much is done.

    Raises:
        OutputError: it exists, or is one where an output of its format would do harm.
        OptionError: no format has its suffix.
    """
    form = format_for_output(path)
    check_output(path, overwrite=overwrite)
    check_place = getattr(form, "check_place", None)
    if check_place is not None:
        check_place(path)


def write_scene(
    scene: Scene, path: str | Path, *, format: str | None = None, overwrite: bool = False, **options: Any
) -> LossReport:
    """Write a scene in the format that the path's suffix, or `format`, names; a URL of a store may stand for the path.

    Where the format has no place for corrections, they are applied (`Scene.corrected`).

    Raises:
        OutputError: the output exists, or cannot be written.
        OptionError: no format has that suffix or name.
    """
    if is_url(path):
        from sceneloom.formats.remote.uploads import uploading

        with uploading(str(path), overwrite=overwrite) as draft:
            return write_scene(scene, draft, format=format, **options)
    where = Path(path)
    form = format_for_output(where) if format is None else format_named(format)
    return write_in(form, scene, where, overwrite=overwrite, **options)
