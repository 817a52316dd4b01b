"""Cuboids as rows of instances and of their boxes at the samples."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Int64Array, finite_rows
from sceneloom.formats.loss import Support
from sceneloom.formats.nuscenes.keyframes import Samples, microseconds
from sceneloom.formats.nuscenes.written_frames import FrameLosses
from sceneloom.formats.nuscenes.written_tables import TableWriter, token_of, write_table, wxyz
from sceneloom.geometry.rotations import conjugate_quaternion, rotate_vectors
from sceneloom.scene.angles import CuboidAngles
from sceneloom.scene.annotations.cuboids import CuboidAnnotation
from sceneloom.scene.at import CuboidPoses, attribute_at, cuboid_poses
from sceneloom.scene.scene import Scene

VISIBILITIES = {"v0-40": "1", "v40-60": "2", "v60-80": "3", "v80-100": "4"}
"""Tokens of the levels, by name. Source: "visibility" of the schema."""

UNKNOWN = "unknown"
"""The category of objects without a class."""

_COUNTS = ("num_lidar_pts", "num_radar_pts")


@dataclass(slots=True)
class Boxes:
    """The boxes of all cuboids at all samples.

    Attributes:
        cuboids: in order.
        poses: of each, at the samples.
        counts: `num_lidar_pts` and `num_radar_pts` counted, (A, S) int64 each.
    """

    cuboids: tuple[CuboidAnnotation, ...]
    poses: tuple[CuboidPoses, ...]
    counts: Mapping[str, Int64Array] = field(default_factory=dict)

    @classmethod
    def of(cls, scene: Scene, samples: Samples) -> "Boxes":
        """Find the boxes of a scene's cuboids."""
        cuboids = tuple(a for a in scene.annotations if isinstance(a, CuboidAnnotation))
        angles = CuboidAngles.of(scene)
        times = samples.timestamps_ns
        # a box there is one of the sample's sweep: as the lidar sees it
        lidar_id = scene.lidars[0].id if scene.lidars else None
        poses = tuple(cuboid_poses(cuboid, times, angles=angles, sensor_id=lidar_id) for cuboid in cuboids)
        shape = (len(cuboids), len(times))
        return cls(cuboids, poses, {name: np.zeros(shape, np.int64) for name in _COUNTS})

    def count(self, name: str, sample: int, points_world: AnyArray) -> None:
        """Count points (N, 3) [m] in the boxes at a sample.

        Args:
            name: "num_lidar_pts" or "num_radar_pts".
            sample: its number.
            points_world: a frame's points.
        """
        for row, box in enumerate(self.poses):
            if box.there[sample]:
                self.counts[name][row, sample] += int(_inside(box, sample, points_world).sum())


def _inside(box: CuboidPoses, sample: int, points_world: AnyArray) -> BoolArray:
    away = points_world - box.centers_world[sample]
    half = box.sizes_lwh[sample] / 2
    reach = float(np.linalg.norm(half))
    near = np.flatnonzero((np.abs(away) <= reach).all(axis=1))
    inner = rotate_vectors(conjugate_quaternion(box.quaternions_xyzw[sample]), away[near])
    inside = np.zeros(len(points_world), np.bool_)
    inside[near] = (np.abs(inner) <= half).all(axis=1)
    return inside


def categories_of(scene: Scene) -> dict[str, str]:
    """Tokens of the categories of all cuboids, by name."""
    labels = [a.label or UNKNOWN for a in scene.annotations if isinstance(a, CuboidAnnotation)]
    return {name: token_of("category", name) for name in dict.fromkeys(labels)}


def write_boxes(
    folder: Path,
    name: str,
    boxes: Boxes,
    samples: Samples,
    categories: Mapping[str, str],
    losses: FrameLosses,
) -> None:
    """Write the tables instance, sample_annotation, attribute and visibility."""
    known: dict[str, str] = {}
    with TableWriter(folder, "instance") as instances, TableWriter(folder, "sample_annotation") as rows:
        for number, cuboid in enumerate(boxes.cuboids):
            poses = boxes.poses[number]
            finite = finite_rows(np.hstack([poses.centers_world, poses.sizes_lwh, poses.quaternions_xyzw]))
            nowhere = int((poses.there & ~finite).sum())
            if nowhere:
                losses.add(
                    "annotations.cuboid.path", "boxes that are no finite numbers are left out", nowhere
                )
            there = np.flatnonzero(poses.there & finite).tolist()
            token = instance_token(cuboid, name)
            _report_losses(cuboid, samples, there, losses)
            if not there:
                continue
            tokens = [token_of("sample_annotation", token, samples.tokens[s]) for s in there]
            instances.add(
                token=token,
                category_token=categories[cuboid.label or UNKNOWN],
                nbr_annotations=len(there),
                first_annotation_token=tokens[0],
                last_annotation_token=tokens[-1],
            )
            stated = _stated(cuboid, samples.timestamps_ns[there])
            for k, sample in enumerate(there):
                rows.add(**_row(boxes, number, sample, samples, token, tokens, k, stated[k], known))
    write_table(folder, "attribute", ({"token": t, "name": n, "description": ""} for n, t in known.items()))
    levels = ({"token": t, "level": n, "description": ""} for n, t in VISIBILITIES.items())
    write_table(folder, "visibility", levels)


def instance_token(cuboid: CuboidAnnotation, name: str) -> str:
    """The id of a cuboid, where it is a text; else a token that is made of it."""
    identifier = cuboid.id
    return (
        identifier if isinstance(identifier, str) and identifier else token_of("instance", name, identifier)
    )


def _stated(cuboid: CuboidAnnotation, times_ns: Int64Array) -> list[dict[str, Any]]:
    """What is stated about a cuboid at times (M,) [ns]."""
    columns = {
        path.name: attribute_at(path, times_ns) for path in cuboid.attributes if path.sensor_id is None
    }
    return [{name: values[k] for name, values in columns.items()} for k in range(len(times_ns))]


def _row(
    boxes: Boxes,
    number: int,
    sample: int,
    samples: Samples,
    token: str,
    tokens: Sequence[str],
    k: int,
    stated: Mapping[str, Any],
    known: dict[str, str],
) -> dict[str, Any]:
    box = boxes.poses[number]
    length, width, height = box.sizes_lwh[sample].tolist()
    listed = _listed(stated.get("attributes"))
    for name in listed:
        known.setdefault(name, token_of("attribute", name))
    counts = {
        name: stated[name] if type(stated.get(name)) is int else int(boxes.counts[name][number, sample])
        for name in _COUNTS
    }
    return {
        "token": tokens[k],
        "sample_token": samples.tokens[sample],
        "instance_token": token,
        "visibility_token": VISIBILITIES.get(str(stated.get("visibility")), ""),
        "attribute_tokens": [known[name] for name in listed],
        "translation": box.centers_world[sample].tolist(),
        "size": [width, length, height],
        "rotation": wxyz(box.quaternions_xyzw[sample]),
        "prev": tokens[k - 1] if k else "",
        "next": tokens[k + 1] if k + 1 < len(tokens) else "",
        **counts,
    }


def _listed(names: Any) -> list[str]:
    """Names of attributes, of which one may stand alone."""
    if isinstance(names, str):
        return [names] if names else []
    return [str(name) for name in names] if isinstance(names, list | tuple) else []


def _report_losses(
    cuboid: CuboidAnnotation, samples: Samples, there: Sequence[int], losses: FrameLosses
) -> None:
    location = "annotations.cuboid"
    losses.add(
        f"{location}.activations", "when each sensor sees a cuboid is left out", len(cuboid.activations)
    )
    if not there:
        losses.add(location, "cuboids that are at no sample are left out", 1)
        return
    own = microseconds(cuboid.path.timestamps_ns)
    at_samples = microseconds(samples.timestamps_ns[list(there)])
    lost = int((~np.isin(own, at_samples)).sum())
    losses.add(f"{location}.path.values", "boxes between samples are left out", lost)
    between = int((~np.isin(at_samples, own)).sum())
    what = "boxes at samples are found between those of the path"
    losses.add(f"{location}.path.values", what, between, Support.APPROXIMATED)
    reported = {"attributes", "visibility", *_COUNTS}
    others = sum(path.name not in reported for path in cuboid.attributes)
    losses.add(f"{location}.attributes", "attributes of other names are left out", others)
    levels = [v for path in cuboid.attributes if path.name == "visibility" for v in path.values]
    unknown = sum(bool(level) and str(level) not in VISIBILITIES for level in levels)
    what = f"levels of visibility other than {', '.join(VISIBILITIES)} are left out"
    losses.add(f"{location}.attributes", what, unknown)
