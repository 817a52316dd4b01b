"""How annotations belong together: links drawn between them, and the graph of parents, groups and links."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.scene.angles import CuboidAngles
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.cuboids import CuboidAnnotation
from sceneloom.scene.annotations.keypoints import PointsAnnotation
from sceneloom.scene.annotations.relations import GroupAnnotation, LinkAnnotation, ObjectAnnotation
from sceneloom.scene.annotations.shapes import ShapeAnnotation
from sceneloom.scene.at import cuboid_poses, points_at, shape_at
from sceneloom.scene.types import Identifier, Key, key_of
from sceneloom.view.annotations.rows import Group, label_of, name_of
from sceneloom.view.colours import colour_of_name, one_packed
from sceneloom.view.feeds import Report
from sceneloom.view.sdk import sdk
from sceneloom.view.stream import Stream, fits

_WIDTH = -2.0
_MOST_NODES = 400
RELATIONS = "relations"


@dataclass(frozen=True, slots=True, eq=False)
class LinkLayer:
    """Shows links of one class as arrows between what they join.

    Attributes:
        group: the links and their entity.
        ends: the annotations that have locations, by id.
        angles: how angles of cuboids are meant.
        origin: (3,) float64 [m], what is taken off locations.
    """

    group: Group
    ends: Mapping[Key, Annotation]
    angles: CuboidAngles
    origin: Float64Array

    def log(self, times_ns: Int64Array) -> None:
        """Log the links at times (M,) [ns] at which both ends are there."""
        starts = np.array([self._locations(one.from_id, times_ns) for one in self.group.annotations])
        stops = np.array([self._locations(one.to_id, times_ns) for one in self.group.annotations])
        known = ~(np.isnan(starts) | np.isnan(stops)).any(axis=2)
        there = fits(starts - self.origin) & fits(stops - self.origin) & fits(stops - starts)
        self.group.stream.leave_out("links", np.count_nonzero(known & ~there))
        origins = np.swapaxes(starts, 0, 1)[there.T] - self.origin
        arrows = sdk().Arrows3D.columns(
            origins=origins,
            vectors=np.swapaxes(stops, 0, 1)[there.T] - self.origin - origins,
            colors=np.full(len(origins), self.group.colour, np.uint32),
            radii=np.full(len(origins), _WIDTH, np.float32),
            labels=[label_of(self.group.annotations[a]) for _, a in np.argwhere(there.T).tolist()],
        )
        cut = arrows.partition(there.sum(axis=0))
        self.group.stream.columns(
            times_ns, self.group.path, cut, self.group.details(there, times_ns), kind="links"
        )

    def _locations(self, identifier: Identifier, times_ns: Int64Array) -> Float64Array:
        """The middle of an annotation at each time, (M, 3) [m], NaN where it is not there."""
        annotation = self.ends.get(key_of(identifier))
        if isinstance(annotation, CuboidAnnotation):
            return cuboid_poses(annotation, times_ns, angles=self.angles).centers_world
        nowhere = np.full((len(times_ns), 3), np.nan)
        if isinstance(annotation, ShapeAnnotation):
            return np.array(
                [nowhere[0] if one is None else one.mean(axis=0) for one in shape_at(annotation, times_ns)]
            )
        if isinstance(annotation, PointsAnnotation) and annotation.paths:
            rows, _ = points_at(annotation, times_ns)[0]
            return rows[:, :3]
        return nowhere


def link_texts(annotations: Sequence[Annotation]) -> Mapping[Identifier, str]:
    """What is stated for the links of each annotation, in a line: `tows: trailer 7`."""
    names = {key_of(one.id): name_of(one) for one in annotations}
    texts: dict[Identifier, list[str]] = {}
    for link in annotations:
        if isinstance(link, LinkAnnotation):
            other = names.get(key_of(link.to_id), str(link.to_id))
            back = names.get(key_of(link.from_id), str(link.from_id))
            texts.setdefault(link.from_id, []).append(f"{label_of(link)}: {other}")
            texts.setdefault(link.to_id, []).append(f"{label_of(link)} of {back}")
    return {identifier: "; ".join(stated) for identifier, stated in texts.items()}


def show_graph(stream: Stream, annotations: Sequence[Annotation], notify: Report) -> bool:
    """Show parents, groups and links as a graph; report whether there is one."""
    edges = [(str(one.parent_id), str(one.id)) for one in annotations if one.parent_id is not None]
    edges += [(str(one.from_id), str(one.to_id)) for one in annotations if isinstance(one, LinkAnnotation)]
    joined = {name for edge in edges for name in edge}
    alone = [one for one in annotations if isinstance(one, GroupAnnotation | ObjectAnnotation)]
    shown = [one for one in annotations if str(one.id) in joined and not isinstance(one, LinkAnnotation)]
    nodes = {str(one.id): one for one in (*shown, *alone)}
    if not nodes:
        return False
    if len(nodes) > _MOST_NODES:
        notify(
            "graph-cut",
            "annotations",
            f"the graph of relations shows {_MOST_NODES} of {len(nodes)} annotations",
        )
        nodes = dict(list(nodes.items())[:_MOST_NODES])
    rr = sdk()
    drawn = rr.GraphNodes(
        list(nodes),
        labels=[name_of(one) for one in nodes.values()],
        colors=np.array([one_packed(colour_of_name(label_of(one))) for one in nodes.values()], np.uint32),
    )
    kept = [edge for edge in edges if edge[0] in nodes and edge[1] in nodes]
    lines = (rr.GraphEdges(kept, graph_type="directed"),) if kept else ()
    stream.static(stream.path(RELATIONS), drawn, *lines)
    return True
