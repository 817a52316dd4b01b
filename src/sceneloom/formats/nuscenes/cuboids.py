"""The boxes of a scene of nuScenes as cuboids: one for each object, with what is stated about it at each sample."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.nuscenes.selection import SceneTables, dangling, rows_by_token
from sceneloom.formats.nuscenes.sensors import MICROSECOND
from sceneloom.formats.nuscenes.tables import AnnotationRow, CategoryRow, InstanceRow, iter_rows
from sceneloom.formats.quaternion_lengths import lengths_of
from sceneloom.scene.angles import CuboidAngles
from sceneloom.scene.annotations.attributes import AttributePath
from sceneloom.scene.annotations.cuboids import CuboidAnnotation, CuboidPath

_TABLES = ("sample_annotation", "instance", "category", "attribute", "visibility")


def build_cuboids(tables: SceneTables, ledger: Ledger) -> tuple[CuboidAnnotation, ...]:
    """Build a cuboid for each instance, in the order in which they come up.

    Raises:
        DataError: a table is missing or wrong, a token leads nowhere, or a box has no size.
    """
    location = tables.location
    for name in _TABLES:
        if not (location.tables / f"{name}.json").is_file():
            problem = "missing; expected the tables of boxes, be they empty"
            ledger.fault("table-missing", DataError(location.tables, f"{name}.json", problem))
            return ()
    rows = [
        row for row in iter_rows(location.tables, "sample_annotation") if row.sample_token in tables.samples
    ]
    instances = rows_by_token(location, "instance", (row.instance_token for row in rows))
    names = {name: rows_by_token(location, name) for name in ("category", "attribute", "visibility")}
    tracks: dict[str, list[AnnotationRow]] = {}
    for row in rows:
        fault = _dangling(tables, row, instances, names)
        if fault is None:
            tracks.setdefault(row.instance_token, []).append(row)
        else:
            ledger.fault("dangling-tokens", fault)
    return tuple(_cuboid(tables, instances[token], track, names) for token, track in tracks.items())


def _dangling(
    tables: SceneTables,
    row: AnnotationRow,
    instances: Mapping[str, InstanceRow],
    names: Mapping[str, Mapping[str, Any]],
) -> DataError | None:
    """What is wrong with the tokens of a row."""
    location, table = tables.location, "sample_annotation"
    if row.instance_token not in instances:
        return dangling(location, table, row.token, "instance", row.instance_token)
    category = instances[row.instance_token].category_token
    if category not in names["category"]:
        return dangling(location, "instance", row.instance_token, "category", category)
    if row.visibility_token and row.visibility_token not in names["visibility"]:
        return dangling(location, table, row.token, "visibility", row.visibility_token)
    lost = next((token for token in row.attribute_tokens if token not in names["attribute"]), None)
    return None if lost is None else dangling(location, table, row.token, "attribute", lost)


def _cuboid(
    tables: SceneTables,
    instance: InstanceRow,
    track: Sequence[AnnotationRow],
    names: Mapping[str, Mapping[str, Any]],
) -> CuboidAnnotation:
    rows = sorted(track, key=lambda row: tables.samples[row.sample_token].timestamp)
    timestamps = [tables.samples[row.sample_token].timestamp for row in rows]
    timestamps_ns = np.array(timestamps, np.int64) * MICROSECOND
    category: CategoryRow = names["category"][instance.category_token]
    return CuboidAnnotation(
        id=instance.token,
        path=CuboidPath(
            timestamps_ns,
            _values(tables, rows),
            MappingProxyType({"tokens": tuple(row.token for row in rows)}),
        ),
        label=category.name,
        attributes=_attributes(rows, timestamps_ns, names),
    )


def _values(tables: SceneTables, rows: Sequence[AnnotationRow]) -> Float64Array:
    """`dx dy dz px py pz roll pitch yaw`: length, width, height; the angles as they are by default."""
    sizes_wlh = np.array([row.size for row in rows])
    quaternions_wxyz = np.array([row.rotation for row in rows])
    wrong = lengths_of(quaternions_wxyz)[1] | (sizes_wlh <= 0).any(axis=1)
    if wrong.any():
        row = rows[int(np.argmax(wrong))]
        problem = f"size {list(row.size)}, rotation {list(row.rotation)}; expected sizes above 0, length 1"
        raise DataError(tables.location.tables / "sample_annotation.json", f"row {row.token}", problem)
    angles = CuboidAngles().from_quaternions(quaternions_wxyz[:, [1, 2, 3, 0]])
    positions = np.array([row.translation for row in rows])
    return np.concatenate([sizes_wlh[:, [1, 0, 2]], positions, angles], axis=1)


def _attributes(
    rows: Sequence[AnnotationRow], timestamps_ns: Int64Array, names: Mapping[str, Mapping[str, Any]]
) -> tuple[AttributePath, ...]:
    """What is stated at each sample; of the visibility nothing, where nothing is stated at any."""
    stated: dict[str, tuple[Any, ...]] = {
        "attributes": tuple(
            tuple(names["attribute"][token].name for token in row.attribute_tokens) for row in rows
        ),
        "num_lidar_pts": tuple(row.num_lidar_pts for row in rows),
        "num_radar_pts": tuple(row.num_radar_pts for row in rows),
    }
    levels = [names["visibility"].get(row.visibility_token) for row in rows]
    if any(levels):
        stated["visibility"] = tuple("" if level is None else level.level for level in levels)
    return tuple(AttributePath(name, values, timestamps_ns) for name, values in stated.items())
