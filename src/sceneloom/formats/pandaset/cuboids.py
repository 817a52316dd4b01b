"""The boxes of a drive as cuboids: one for each uuid, at the times of the sweeps."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.errors import DataError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.pandaset.pickled_frames import PickledFrame, read_pickled_frame
from sceneloom.formats.pandaset.sensors import LIDARS, Sweeps
from sceneloom.formats.pandaset.spec import numbered_files
from sceneloom.scene.annotations.attributes import AttributePath
from sceneloom.scene.annotations.cuboids import CuboidAnnotation, CuboidPath

_LABEL = "label"
_STATED = ("camera_used",)
_STATED_PREFIXES = ("attributes.", "cuboids.")
_NOTHING = ("None", "", "-", "nan", "-1")
"""Values, as texts, by which the files state nothing."""


@dataclass(slots=True)
class _Track:
    """What is stated about one object, sweep by sweep."""

    label: str
    stationary: bool | None
    timestamps_ns: list[int] = field(default_factory=list)
    values: list[Float64Array] = field(default_factory=list)
    stated: dict[str, dict[int, Any]] = field(default_factory=dict)

    def says(self, key: str) -> bool:
        """Whether something is stated at all; of the label, whether it changes."""
        values = [str(value) for value in self.stated[key].values()]
        return len(set(values)) > 1 if key == _LABEL else any(value not in _NOTHING for value in values)


def build_cuboids(drive: Path, sweeps: Sweeps, ledger: Ledger) -> tuple[CuboidAnnotation, ...]:
    """Build a cuboid for each uuid, in the order in which they come up; () where there are no annotations.

    Raises:
        DataError: a file is wrong, or there are more files than sweeps.
    """
    timestamps = timestamps_of(drive / "annotations" / "cuboids", sweeps)
    tracks: dict[str, _Track] = {}
    for file, timestamp_ns in timestamps.items():
        try:
            _add(tracks, read_pickled_frame(file), timestamp_ns)
        except DataError as error:
            ledger.fault("cuboids", error)
    return tuple(_cuboid(name, track) for name, track in tracks.items())


def timestamps_of(folder: Path, sweeps: Sweeps) -> dict[Path, int]:
    """The files of annotations, and the time of the sweep with the same number [ns].

    Raises:
        DataError: a file has no sweep.
    """
    times = {_number(file): int(t) for file, t in zip(sweeps.files, sweeps.timestamps_ns, strict=True)}
    files = numbered_files(folder, r"\.pkl(\.gz)?")
    lost = [file for file in files if _number(file) not in times]
    if lost:
        raise DataError(lost[0], "", f"there is no sweep of this number in {sweeps.folder}")
    return {file: times[_number(file)] for file in files}


def _number(file: Path) -> int:
    return int(file.name.partition(".")[0])


def _add(tracks: dict[str, _Track], frame: PickledFrame, timestamp_ns: int) -> None:
    values = _values(frame)
    uuids = [str(name) for name in frame.column("uuid").tolist()]
    labels = frame.column("label").tolist()
    still = frame.columns["stationary"].tolist() if "stationary" in frame.columns else [None] * frame.count
    further = {
        name: column.tolist()
        for name, column in frame.columns.items()
        if name in _STATED or name.startswith(_STATED_PREFIXES)
    }
    if len(set(uuids)) != len(uuids):
        twice = next(name for name in uuids if uuids.count(name) > 1)
        raise DataError(frame.file, "uuid", f"{twice!r} stands twice; expected each object once")
    for row, name in enumerate(uuids):
        known = still[row] if isinstance(still[row], bool) else None
        track = tracks.setdefault(name, _Track(str(labels[row]), known))
        track.timestamps_ns.append(timestamp_ns)
        track.values.append(values[row])
        for key, column in further.items():
            track.stated.setdefault(key, {})[timestamp_ns] = column[row]
        track.stated.setdefault(_LABEL, {})[timestamp_ns] = str(labels[row])


def _values(frame: PickledFrame) -> Float64Array:
    """Rows `dx dy dz px py pz roll pitch yaw`, degrees.

    `dimensions.x` is the width, `dimensions.y` the length, and a box of yaw 0 looks along the world's y.

    Source: class Cuboids of the development kit, and its function of a box's corners.
    """
    width, length, height = (frame.numbers(f"dimensions.{axis}") for axis in "xyz")
    positions = [frame.numbers(f"position.{axis}") for axis in "xyz"]
    sizes = np.stack([length, width, height], axis=1)
    if (sizes <= 0).any():
        k = int(np.argmax((sizes <= 0).any(axis=1)))
        raise DataError(frame.file, f"row {k}: dimensions", f"{sizes[k].tolist()}; expected sizes above 0")
    yaws = np.degrees(frame.numbers("yaw")) + 90.0
    level = np.zeros(frame.count)
    return np.concatenate([sizes, np.stack([*positions, level, level, yaws], axis=1)], axis=1)


def _cuboid(name: str, track: _Track) -> CuboidAnnotation:
    timestamps_ns = np.array(track.timestamps_ns, np.int64)
    return CuboidAnnotation(
        id=name,
        path=CuboidPath(timestamps_ns, np.stack(track.values)),
        label=track.label,
        stationary=track.stationary,
        attributes=tuple(_attribute(key, stated) for key, stated in track.stated.items() if track.says(key)),
    )


def _attribute(key: str, stated: dict[int, Any]) -> AttributePath:
    """What is stated, at the times when that changes; where a text is missing it is empty."""
    name = key.removeprefix("attributes.").removeprefix("cuboids.")
    times = list(stated)
    values = [_value(name, value) for value in stated.values()]
    changes = [k for k in range(len(values)) if k == 0 or values[k] != values[k - 1]]
    return AttributePath(
        name, tuple(values[k] for k in changes), np.array([times[k] for k in changes], np.int64)
    )


def _value(name: str, value: Any) -> Any:
    if isinstance(value, bool) or not isinstance(value, int):
        return "" if str(value) in _NOTHING else value
    return LIDARS[value] if name == "sensor_id" and value in (0, 1) else value
