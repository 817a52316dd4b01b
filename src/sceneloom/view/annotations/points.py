"""Named points in space, and points of clouds that have labels."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sceneloom.arrays import Float32Array, Float64Array, Int64Array, UInt16Array
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.keypoints import PointsAnnotation, locations_of
from sceneloom.scene.annotations.labelled_points import LabeledPointsAnnotation
from sceneloom.scene.at import Bracket
from sceneloom.scene.types import Identifier, Key, key_of
from sceneloom.view.annotations.rows import Group, label_of, name_of
from sceneloom.view.colours import colour_of_name
from sceneloom.view.sdk import sdk
from sceneloom.view.stream import Stream, fits

_MARK = -4.0
_LABELLED = -2.4
_CLASSES = 65_535


@dataclass(frozen=True, slots=True, eq=False)
class PointsLayer:
    """Shows named points of annotations of one class.

    Attributes:
        group: the annotations and their entity.
        origin: (3,) float64 [m], what is taken off locations.
    """

    group: Group
    origin: Float64Array

    def log(self, times_ns: Int64Array) -> None:
        """Log the points at times (M,) [ns]."""
        locations: list[list[Float64Array]] = [[] for _ in range(len(times_ns))]
        names: list[list[str]] = [[] for _ in range(len(times_ns))]
        for annotation in self.group.annotations:
            for k, path in enumerate(annotation.paths):
                found = Bracket.of(path.timestamps_ns, times_ns, stationary=bool(annotation.stationary))
                if len(path.timestamps_ns) == 0:
                    continue
                rows = found.blend(locations_of(path.values))
                held = fits(rows - self.origin).all(axis=1)
                self.group.stream.leave_out("named points", np.count_nonzero(found.there & ~held))
                for m in np.flatnonzero(found.there & held).tolist():
                    locations[m].append(rows[m])
                    names[m] += [point_name(annotation, k)] * len(rows[m])
        counts = np.array([len(one) for one in names], np.int64)
        positions = np.concatenate([np.zeros((0, 3)), *(rows for moment in locations for rows in moment)])
        columns = sdk().Points3D.columns(
            positions=positions - self.origin,
            colors=np.full(len(positions), self.group.colour, np.uint32),
            radii=np.full(len(positions), _MARK, np.float32),
            labels=[name for moment in names for name in moment],
        )
        self.group.stream.columns(times_ns, self.group.path, columns.partition(counts), kind="named points")


def point_name(annotation: PointsAnnotation, k: int) -> str:
    """What point `k` of an annotation is called."""
    if annotation.labels is not None and k < len(annotation.labels):
        return annotation.labels[k]
    path = annotation.paths[k]
    return name_of(annotation) if path.id is None else f"{name_of(annotation)}: {path.id}"


@dataclass(slots=True, eq=False)
class LabelledPoints:
    """The labelled points of a scene, by the frames that they are of.

    Attributes:
        stream: where to.
        entries: for each sensor and number of a frame (None: the sensor as a whole), labels and rows of points.
    """

    stream: Stream
    entries: Mapping[tuple[Key, int | None], Sequence[tuple[int, Int64Array]]]
    _names: dict[int, str] = field(default_factory=dict)

    @classmethod
    def of(cls, stream: Stream, annotations: Sequence[Annotation]) -> "LabelledPoints":
        """Collect them; each annotation is a class of its own for the viewer, with a colour and a name."""
        rr = sdk()
        labelled = [one for one in annotations if isinstance(one, LabeledPointsAnnotation)][:_CLASSES]
        entries: dict[tuple[Key, int | None], list[tuple[int, Int64Array]]] = {}
        for number, annotation in enumerate(labelled, start=1):
            for entry in annotation.labeled_points:
                rows = entry.point_ids.astype(np.int64)
                entries.setdefault((key_of(entry.sensor_id), entry.sensor_frame), []).append((number, rows))
        if labelled:
            infos = [
                rr.AnnotationInfo(id=number, label=_class_name(one), color=_class_colour(one))
                for number, one in enumerate(labelled, start=1)
            ]
            stream.static(stream.root, rr.AnnotationContext(infos))
        return cls(stream, entries)

    def log(
        self,
        sensor_id: Identifier,
        frame: int | None,
        path: str,
        time_ns: int | None,
        positions: Float32Array,
    ) -> None:
        """Log those of a frame over its cloud.

        Args:
            sensor_id: whose frame it is.
            frame: its number; None for a sensor without frames.
            path: of the cloud's entity, in whose frame the positions are.
            time_ns: when it is shown [ns]; None for always.
            positions: (N, 3) [m], of all points of the frame.
        """
        found = self.entries.get((key_of(sensor_id), frame))
        if not found:
            return
        rows = np.concatenate([rows for _, rows in found])
        classes: UInt16Array = np.repeat(
            np.array([number for number, _ in found], np.uint16), [len(rows) for _, rows in found]
        )
        there = rows < len(positions)
        there[there] = fits(positions[rows[there]])
        shown = sdk().Points3D(
            positions[rows[there]], class_ids=classes[there], radii=np.float32(_LABELLED), show_labels=False
        )
        if time_ns is None:
            self.stream.static(f"{path}/labelled", shown)
            self.stream.count("labelled clouds", 1)
        else:
            self.stream.log(time_ns, f"{path}/labelled", shown, kind="labelled clouds", size=14 * len(rows))


def _class_name(annotation: LabeledPointsAnnotation) -> str:
    return name_of(annotation) if annotation.is_instance else label_of(annotation)


def _class_colour(annotation: LabeledPointsAnnotation) -> Any:
    reported = annotation.id if annotation.is_instance else label_of(annotation)
    return colour_of_name(reported)
