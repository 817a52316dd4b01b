"""Data sets of YOLO: boxes, outlines, keypoints and oriented boxes as lines of text, read and written.

Source: "Datasets" of the Ultralytics documentation (detect, segment, pose, OBB); for obj.names and obj.data the
description of Darknet. All numbers are shares of the image's width and height.
"""

import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base.files import LARGEST_SETTINGS, check_length, file_faults, open_file, read_settings
from sceneloom.formats.base.images import IMAGE_SUFFIXES, images_image_size
from sceneloom.formats.base.losses import Losses, LossReport, field_losses
from sceneloom.formats.base.output import FolderKind
from sceneloom.formats.labelling.drawn import (
    MOST_FOLDERS,
    Drawn,
    Frame,
    Kind,
    Labels,
    Sheet,
    bounds_of,
    corners_of,
    ordered_points,
    rotated_of,
)
from sceneloom.formats.labelling.spec import YOLO, YOLO_FILES, file_in, is_yolo
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import key_of
from sceneloom.warnings import WarningKind

_TASKS = ("detect", "segment", "pose", "obb")
_SUBSETS = ("train", "val", "test")
_SIZE = (1920, 1080)  # of images that are not there


def read_yolo(
    path: Path, *, lenient: bool = False, rate_hz: float | str | None = None, task: str | None = None
) -> Scene:
    """Read the labels of all subsets of a data set.

    Args:
        rate_hz: images per second where names state no times.
        task: "detect", "segment", "pose" or "obb"; None: "pose" where kpt_shape is stated, "obb" where each line has
            eight coordinates, else "detect" for lines of four and "segment" for others.

    Raises:
        OptionError: there is no such task, or the rate is no number above 0.
        DataError: it is no such data set, or a line is none.
    """
    if task not in (None, *_TASKS):
        raise OptionError(f"task {task!r}; expected one of {', '.join(_TASKS)}")
    files = [one for one in file_in(path, *YOLO_FILES) if is_yolo(one)]
    if not files:
        raise DataError(path, "", "no data.yaml with `names` and no obj.names; expected a data set of YOLO")
    labels = Labels.of(files[0], "yolo", lenient=lenient, rate_hz=rate_hz)
    with labels.ledger.telling():
        _Reader(files[0], labels, task).read()
        return labels.scene()


class _Reader:
    """Reads a data set file by file."""

    def __init__(self, file: Path, labels: Labels, task: str | None) -> None:
        self.folder, self.labels, self.task = file.parent, labels, task
        self.names: list[str] = []
        self.points, self.dimensions = 0, 3
        self.point_names: dict[int, list[str]] = {}
        self.settings: dict[str, Any] = {}
        if file.suffix.lower() in (".yaml", ".yml"):
            self._take_settings(file)
        else:
            listed = self.folder / "obj.names"
            self.names = _lines(listed if listed.is_file() else file)
            self.settings = {"train": "."}

    def _take_settings(self, file: Path) -> None:
        self.settings = _plain_yaml(file)
        names = self.settings.get("names")
        if isinstance(names, dict):
            numbers = [int(key) for key in names if re.fullmatch(r"[0-9]{1,5}", key)]
            self.names = [str(names.get(str(k), k)) for k in range(max(numbers, default=-1) + 1)]
        elif isinstance(names, list):
            self.names = [str(name) for name in names]
        shape = self.settings.get("kpt_shape")
        if (
            isinstance(shape, list)
            and len(shape) == 2
            and all(isinstance(one, str) and re.fullmatch(r"[0-9]{1,4}", one) for one in shape)
        ):
            self.points, self.dimensions = int(shape[0]), int(shape[1])
            if self.dimensions not in (2, 3):
                raise DataError(file, "kpt_shape", f"{shape}; expected a number of points and 2 or 3")
        given = self.settings.get("kpt_names")
        if isinstance(given, dict):
            self.point_names = {int(k): names for k, names in given.items() if k.isdigit() and isinstance(names, list)}

    def read(self) -> None:
        pairs = dict(self._pairs())
        texts = sorted(pairs)
        rows = {text: list(self._rows(text)) for text in texts}
        task = self.task or self._guess([len(row) for found in rows.values() for _, row in found])
        self.labels.spec = {"tool": "yolo", "labels": self.names}
        missing = 0
        for k, text in enumerate(texts):
            image, name = pairs[text]
            size = (0, 0)
            if image is not None:
                self.labels.roots.append(Path(str(image)[: -len(name)]) if str(image).endswith(name) else image.parent)
                size = images_image_size(image)
            missing += image is None and bool(rows[text])
            frame = self.labels.add_frame(Frame(k, name, *(size if image is not None else _SIZE)))
            for line, row in rows[text]:
                try:
                    self.labels.drawn += self._of_line(text, line, row, task, frame)
                except DataError as error:
                    self.labels.ledger.fault("lines", error)
        self.labels.roots = list(dict.fromkeys(self.labels.roots))
        if missing:
            message = f"images are missing, whose size lines count in; {_SIZE[0]}x{_SIZE[1]} is assumed"
            where = str(self.labels.path)
            self.labels.ledger.note(WarningKind.ASSUMED, "yolo-image-size", where, message, count=missing)

    def _guess(self, counts: list[int]) -> str:
        if self.points:
            return "pose"
        found = Counter(counts)
        return "obb" if found and set(found) == {9} else "detect" if set(found) <= {5, 6} else "segment"

    def _pairs(self) -> Iterator[tuple[Path, tuple[Path | None, str]]]:
        """Files of labels with their images, if there are any, and the names of these in their folder of images."""
        base = self.folder
        if isinstance(root := self.settings.get("path"), str) and (self.folder / root).is_dir() and ".." not in root:
            base = self.folder / root
        given = [self.settings.get(subset) for subset in _SUBSETS]
        listed = [one for entry in given for one in (entry if isinstance(entry, list) else [entry])]
        found = False
        for entry in [one for one in listed if isinstance(one, str)] or ["images"]:
            start = base / entry
            for file, name in self._images(start, base):
                found = True
                yield _text_of(file), (file, name)
        for folder in (base / "labels", base / "obj_train_data", base / "obj_valid_data"):
            for text in sorted(folder.rglob("*.txt")) if folder.is_dir() else ():
                name = text.relative_to(folder).with_suffix(".jpg").as_posix()
                image = _image_of(text)
                if image is None or not found or image.parent == text.parent:
                    yield text, (image, name if image is None else str(Path(name).with_suffix(image.suffix)))

    def _images(self, start: Path, base: Path) -> Iterator[tuple[Path, str]]:
        if start.is_file() and start.suffix == ".txt":
            for line in _lines(start):
                image = base / line.removeprefix("data/").removeprefix("./")
                if image.is_file() and ".." not in line:
                    yield image, _name_of(image, base)
        elif start.is_dir():
            for image in sorted(start.rglob("*")):
                if image.suffix.lower() in IMAGE_SUFFIXES and image.is_file():
                    yield image, _name_of(image, base)

    def _rows(self, text: Path) -> Iterator[tuple[int, list[str]]]:
        if not text.is_file():
            return
        with file_faults(text), open_file(text) as file:
            check_length(text)
            for number, line in enumerate(file, 1):
                words = line.decode("utf-8", "replace").split()
                if words:
                    yield number, words

    def _of_line(self, text: Path, line: int, words: list[str], task: str, frame: int) -> list[Drawn]:
        where = f"line {line}"
        try:
            number, *shares = [float(word) for word in words]
        except ValueError:
            raise DataError(text, where, f"{' '.join(words)[:60]!r}; expected numbers") from None
        if not all(abs(one) <= 1e6 for one in (number, *shares)) or number != int(number) or number < 0:
            raise DataError(text, where, f"{' '.join(words)[:60]!r}; expected a class and shares of the image")
        label = self.names[int(number)] if number < len(self.names) else None
        if label is None:
            self.labels.skipped("labels", f"{text.name}, {where}", "numbers of classes that the file does not name")
        size = np.array([self.labels.frames[frame].width, self.labels.frames[frame].height], np.float64)
        values = np.array(shares)
        if task == "pose" and len(values) in (4, 4 + self.points * self.dimensions):
            found = [Drawn(Kind.BOX, frame, _box(values[:4], size), label)]
            if len(values) > 4:
                found.append(self._keypoints(values[4:], size, frame, label, int(number)))
            for one in found:
                one.track = f"{self.labels.frames[frame].number}-{line - 1}"
            return found
        if task != "obb" and len(values) in (4, 5):
            one = Drawn(Kind.BOX, frame, _box(values[:4], size), label)
            if len(values) == 5:
                one.attributes["score"] = float(values[4])
            return [one]
        if len(values) < 6 or len(values) % 2 or task in ("detect", "pose"):
            raise DataError(text, where, f"{len(words)} numbers; expected those of the task {task}")
        ring = values.reshape(-1, 2) * size
        rotated = rotated_of(ring) if task == "obb" else None
        if rotated is None:
            return [Drawn(Kind.POLYGON, frame, ring, label)]
        if abs(rotated[4]) < 1e-9:
            box = np.array([rotated[0] - rotated[2] / 2, rotated[1] - rotated[3] / 2, rotated[2], rotated[3]])
            return [Drawn(Kind.BOX, frame, box, label)]
        return [Drawn(Kind.ROTATED, frame, rotated, label)]

    def _keypoints(self, values: Float64Array, size: Float64Array, frame: int, label: str | None, number: int) -> Drawn:
        rows = values.reshape(-1, self.dimensions)
        flags = rows[:, 2] if self.dimensions == 3 else np.where((rows == 0).all(axis=1), 0.0, 2.0)
        points = np.column_stack([rows[:, :2] * size, np.clip(np.rint(flags), 0, 2)])
        names = self.point_names.get(number, [])
        stated = tuple(map(str, names)) if len(names) == len(rows) else tuple(map(str, range(len(rows))))
        return Drawn(Kind.POINTS, frame, points, label, names=stated)


def _box(shares: Float64Array, size: Float64Array) -> Float64Array:
    centre, extent = shares[:2] * size, shares[2:4] * size
    return np.concatenate([centre - extent / 2, extent])


def _name_of(image: Path, base: Path) -> str:
    """The name of an image from its folder of images on."""
    parts = image.relative_to(base).parts if image.is_relative_to(base) else (image.name,)
    starts = [k for k, part in enumerate(parts) if part in ("images", "obj_train_data", "obj_valid_data")]
    return "/".join(parts[starts[0] + 1 :] if starts else parts)


def _text_of(image: Path) -> Path:
    """The file of labels of an image: in `labels` instead of `images`, or beside it."""
    parts = list(image.parts)
    for k in range(len(parts) - 2, -1, -1):
        if parts[k] == "images":
            parts[k] = "labels"
            break
    return Path(*parts).with_suffix(".txt")


def _image_of(text: Path) -> Path | None:
    """The image of a file of labels: in `images` instead of `labels`, or beside it."""
    parts = list(text.parts)
    for k in range(len(parts) - 2, -1, -1):
        if parts[k] == "labels":
            parts[k] = "images"
            break
    for suffix in IMAGE_SUFFIXES:
        image = Path(*parts).with_suffix(suffix)
        if image.is_file():
            return image
    return None


def _lines(path: Path) -> list[str]:
    text = read_settings(path).decode("utf-8", "replace")
    return [line.strip() for line in text.splitlines() if line.strip()]


_KEY = re.compile(r"^(\s*)(?:\"([^\"]*)\"|'([^']*)'|([^\s#:\"'\[{-][^:#]*?|-?[0-9]+))\s*:(?:\s+(.*))?$")


def _plain_yaml(path: Path) -> dict[str, Any]:
    """Read what data sets state: names with texts, lists of texts, and names of these, two levels deep.

    A parser of all of YAML comes with an extra; these files need none.
    """
    found: dict[str, Any] = {}
    section: dict[str, Any] | list[Any] | None = None
    name, inner = "", ""
    content = read_settings(path)
    if len(content) > LARGEST_SETTINGS:
        raise DataError(path, "", f"{len(content)} bytes; expected {LARGEST_SETTINGS} at most")
    for line in content.decode("utf-8-sig", "replace").splitlines():
        plain = re.sub(r"(^|\s)#.*$", "", line).rstrip()
        if not plain.strip():
            continue
        item = re.match(r"^\s*-\s+(.*)$", plain)
        entry = None if item else _KEY.match(plain)
        if item and name:
            text = _scalar(item[1])
            if isinstance(section, dict) and inner and not plain.startswith("-"):
                section.setdefault(inner, [])
                if isinstance(section[inner], list):
                    section[inner].append(text)
                continue
            section = section if isinstance(section, list) else []
            section.append(text)
            found[name] = section
        elif entry:
            key = next(one for one in entry.groups()[1:4] if one is not None).strip()
            value = _scalar(entry[5] or "")
            if entry[1] and name:
                section = section if isinstance(section, dict) else {}
                section[key] = value if entry[5] else []
                inner, found[name] = key, section
            else:
                name, inner, section = key, "", None
                found[name] = value
    return found


def _scalar(text: str) -> Any:
    """A text, or a list or mapping of texts in brackets."""
    plain = text.strip()
    if plain[:1] == "[" and plain[-1:] == "]":
        return [_scalar(one) for one in _split(plain[1:-1])]
    if plain[:1] == "{" and plain[-1:] == "}":
        pairs = [one.partition(":") for one in _split(plain[1:-1])]
        return {str(_scalar(key)): _scalar(value) for key, _, value in pairs}
    if len(plain) > 1 and plain[0] == plain[-1] == "'":
        return plain[1:-1].replace("''", "'")
    if len(plain) > 1 and plain[0] == plain[-1] == '"':
        return re.sub(r"\\(.)", r"\1", plain[1:-1])
    return plain


def _split(text: str) -> list[str]:
    """Cut at commas that are in no quotes."""
    return [one.strip() for one in re.findall(r"(?:\"(?:\\.|[^\"\\])*\"|'[^']*'|[^,])+", text) if one.strip()]


# writing

_FOLDER = FolderKind(
    "data set of YOLO",
    (
        "data\\.yaml",
        *("/".join(["images", *[".*"] * depth]) for depth in range(1, MOST_FOLDERS + 1)),
        *("/".join(["labels", *[".*"] * (depth - 1), ".*\\.txt"]) for depth in range(1, MOST_FOLDERS + 1)),
    ),
    marker="data\\.yaml",
)
_FITS = {
    "detect": (Kind.BOX,),
    "segment": (Kind.BOX, Kind.POLYGON, Kind.ROTATED),
    "pose": (Kind.BOX, Kind.POINTS),
    "obb": (Kind.BOX, Kind.ROTATED),
}
_FORM = ".10g"


def write_yolo(
    scene: Scene, path: Path, *, images: str = "copy", task: str | None = None, overwrite: bool = False
) -> LossReport:
    """Write a folder with data.yaml, labels and images.

    Args:
        images: "copy" writes images, without which the numbers mean nothing; "none" leaves them out.
        task: "detect", "segment", "pose" or "obb"; None: what the shapes ask for, keypoints first, then rotated boxes.

    Raises:
        OptionError: there is no such task or choice.
        OutputError: the folder exists, or cannot be written.
    """
    if task not in (None, *_TASKS):
        raise OptionError(f"task {task!r}; expected one of {', '.join(_TASKS)}")
    losses = Losses(field_losses(scene, YOLO.supports))
    sheet = Sheet.of(scene, losses)
    kinds = {one.kind for drawn in sheet.drawn for one in drawn}
    if task is None:
        order = ((Kind.POINTS, "pose"), (Kind.ROTATED, "obb"), (Kind.POLYGON, "segment"))
        task = next((name for kind, name in order if kind in kinds), "detect")
    others = [kind for kind in kinds if kind not in _FITS[task]]
    sheet.report_kinds(*others, what=f"has no field in the task {task}; `--output-option task=NAME` chooses another")
    count = sum(len(drawn) for drawn in sheet.drawn)
    losses.dropped("annotations.box_2d.id", "ids and attributes are left out: lines have none", count=count)
    names = sheet.labels()
    unlabelled = any(one.label is None for drawn in sheet.drawn for one in drawn)
    names += ["unlabelled"] if unlabelled and "unlabelled" not in names else []
    points = sheet.point_names() if task == "pose" else {}
    width = max(map(len, points.values()), default=0)

    def write(draft: Path) -> None:
        shown = "".join(f"  {k}: {_quoted(name)}\n" for k, name in enumerate(names))
        text = f"train: images\nval: images\nnames:\n{shown}"
        if width:
            text += f"kpt_shape: [{width}, 3]\nkpt_names:\n"
            for k, name in enumerate(names):
                listed = [*points.get(name, []), *map(str, range(len(points.get(name, [])), width))]
                text += f"  {k}: [{', '.join(map(_quoted, listed))}]\n"
        draft.write_text(text, encoding="utf-8", newline="\n")
        for frame, drawn in zip(sheet.frames, sheet.drawn, strict=True):
            size = np.array([frame.width, frame.height], np.float64)
            lines = [
                line
                for parts in _objects(drawn)
                for line in _written(parts, task, names, points.get(parts[0].label or "", []), width, size)
            ] if frame.width and frame.height else []  # fmt: skip
            if drawn and not (frame.width and frame.height):
                losses.dropped("annotations", "left out: the size of the image is not known", count=len(drawn))
            file = (draft.parent / "labels" / frame.name).with_suffix(".txt")
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8", newline="\n")

    return sheet.write(path, "\0", "data.yaml", _FOLDER, write, images=images, overwrite=overwrite)


def _quoted(text: str) -> str:
    plain = re.sub(r"[\x00-\x1f]", " ", text).replace("\\", "\\\\").replace('"', '\\"')
    return f'"{plain}"'


def _objects(drawn: list[Drawn]) -> Iterator[list[Drawn]]:
    """Shapes in the order of the frame; keypoints with the box of their object."""
    objects: dict[Any, list[Drawn]] = {}
    for k, one in enumerate(drawn):
        joined = one.kind in (Kind.BOX, Kind.POINTS) and one.part == 1 and one.track is not None
        objects.setdefault((key_of(one.track), one.label) if joined and one.track is not None else k, []).append(one)
    yield from objects.values()


def _written(
    parts: list[Drawn], task: str, names: list[str], points: list[str], width: int, size: Float64Array
) -> Iterator[str]:
    """The lines of an object."""
    fitting = {one.kind: one for one in parts if one.kind in _FITS[task]}
    if not fitting:
        return
    label = next(iter(fitting.values())).label
    number = names.index("unlabelled" if label is None else label)
    if task == "pose":
        rows = ordered_points(fitting[Kind.POINTS], points) if Kind.POINTS in fitting else np.zeros((0, 3))
        box = fitting[Kind.BOX].values if Kind.BOX in fitting else None
        seen = rows[rows[:, 2] > 0]
        if box is None:
            box = bounds_of(seen) if len(seen) else np.zeros(4)
        padded = np.zeros((width, 3))
        padded[: len(rows)] = rows
        padded[:, :2] /= size
        yield _line(number, _shares(box, size), padded.reshape(-1))
        return
    for kind, one in fitting.items():
        if kind is Kind.BOX and task != "obb":
            yield _line(number, _shares(one.values, size))
        else:
            rotated = (
                np.array([*(one.values[:2] + one.values[2:] / 2), *one.values[2:], 0.0]) if kind is Kind.BOX else None
            )
            ring = one.values if kind is Kind.POLYGON else corners_of(one.values if rotated is None else rotated)
            yield _line(number, (ring / size).reshape(-1))


def _shares(box: Float64Array, size: Float64Array) -> Float64Array:
    return np.concatenate([(box[:2] + box[2:] / 2) / size, box[2:] / size])


def _line(number: int, *values: Float64Array) -> str:
    return " ".join([str(number), *(format(value, _FORM) for value in np.concatenate(values).tolist())])
