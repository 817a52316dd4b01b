"""The layout of the viewer, made for the drives at hand."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sceneloom.geometry.rotations import conjugate_quaternion, rotate_vectors
from sceneloom.scene.annotations.relations import EventAnnotation
from sceneloom.scene.motion import GnssSensor, ImuSensor
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier
from sceneloom.view.annotations.relations import RELATIONS
from sceneloom.view.annotations.states import ATTRIBUTES, EVENTS, LIST
from sceneloom.view.clouds import SENSORS, WORLD
from sceneloom.view.depths import DEPTH
from sceneloom.view.images import IMAGE
from sceneloom.view.locations import Locations
from sceneloom.view.motion import EARTH, EGO, GNSS, IMU, MAP
from sceneloom.view.notes import NOTES
from sceneloom.view.sdk import blueprint_sdk
from sceneloom.view.settings import ViewSettings
from sceneloom.view.stream import TIME, escaped

_BEHIND, _ABOVE, _AHEAD = 14.0, 7.0, 8.0
"""Where the eye stands behind the ego, and where it looks [m]."""
_MOVED = 2.0
"""How far the ego must have come for its trajectory to notify where forward is [m]."""
_IN_IMAGES = ("annotations", "tracks/boxes", "tracks/history")
"""What has a location in the world and is shown through the camera models, too."""
_BACKGROUND = (16, 18, 22)


@dataclass(frozen=True, slots=True, eq=False)
class Facts:
    """What a layout depends on.

    Attributes:
        root: the drive's entity.
        title: its name.
        cameras: those with images.
        eye, target: (3,) [m], where the eye is, and what it looks at: in the ego's frame if it follows the ego.
        follows: whether the eye moves with the ego.
        curves: of each inertial unit, its id and the names of its streams.
        depths, gnss, plan, earth, events, attributes, relations, listed: whether there is anything of it.
    """

    root: str
    title: str
    cameras: tuple[Identifier, ...]
    eye: tuple[float, ...]
    target: tuple[float, ...]
    follows: bool
    curves: tuple[tuple[Identifier, tuple[str, ...]], ...]
    depths: bool
    gnss: bool
    plan: bool
    earth: bool
    events: bool
    attributes: bool
    relations: bool
    listed: bool

    @classmethod
    def of(
        cls,
        name: str,
        scene: Scene,
        locations: Locations,
        cameras: tuple[Identifier, ...],
        settings: ViewSettings,
    ) -> "Facts":
        """Look at what a scene has."""
        eye, target = _eye(locations)
        gnss = any(isinstance(sensor, GnssSensor) and len(sensor.timestamps_ns) for sensor in scene.sensors)
        joined = any(
            one.parent_id is not None or one.type in {"link", "group", "object"} for one in scene.annotations
        )
        return cls(
            root=f"/{escaped(name)}",
            title=name,
            cameras=cameras,
            eye=eye,
            target=target,
            follows=locations.path is not None,
            curves=tuple(
                (one.id, tuple(one.streams))
                for one in scene.sensors
                if isinstance(one, ImuSensor) and one.streams
            ),
            depths=settings.depth is not None,
            gnss=gnss,
            plan=gnss or locations.path is not None,
            earth=gnss and settings.map_tiles,
            events=any(isinstance(one, EventAnnotation) for one in scene.annotations),
            attributes=any(one.is_timed and one.values for one in scene.attributes),
            relations=joined,
            listed=bool(scene.annotations) or any(not one.is_timed for one in scene.attributes),
        )


def _eye(locations: Locations) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Behind and above the ego, looking where it goes; seen from the ego, whose axes may point anywhere."""
    forward, up = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
    path = locations.path
    if path is not None:
        back = conjugate_quaternion(path.quaternions_xyzw[:1])
        up = rotate_vectors(back, up[None])[0]
        steps = np.linalg.norm(path.positions - path.positions[0], axis=1)
        trajectory = path.positions[int(np.argmax(steps > _MOVED))] - path.positions[0]
        if steps.max() > _MOVED:
            forward = rotate_vectors(back, trajectory[None])[0]
        forward = forward - (forward @ up) * up
        length = float(np.linalg.norm(forward))
        forward = forward / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])
    eye = _ABOVE * up - _BEHIND * forward
    return tuple(eye.tolist()), tuple((_AHEAD * forward).tolist())


def layout(drives: Sequence[Facts]) -> Any:
    """Make the layout: of one drive, or of several, each under a tab of its own, with all worlds over each other."""
    rrb = blueprint_sdk()
    parts = [_drive(facts) for facts in drives]
    if len(drives) == 1:
        content = parts[0]
    else:
        together = rrb.Spatial3DView(
            origin="/", contents=[f"+ {facts.root}/{WORLD}/**" for facts in drives], name="together"
        )
        content = rrb.Tabs(*parts, together, active_tab=0)
    return rrb.Blueprint(
        content,
        rrb.BlueprintPanel(state="expanded"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIME),
        auto_layout=False,
        auto_views=False,
    )


def _drive(facts: Facts) -> Any:
    rrb = blueprint_sdk()
    worlds = [_world(facts, "world", follows=facts.follows)]
    if facts.follows:
        worlds.append(_world(facts, "from afar", follows=False))
    top = rrb.Tabs(*worlds, active_tab=0) if len(worlds) > 1 else worlds[0]
    tabs = rrb.Tabs(*_tabs(facts), active_tab=0)
    left = rrb.Vertical(top, tabs, row_shares=[3, 1])
    if not facts.cameras:
        return _named(left, facts)
    images = [_camera(facts, camera_id) for camera_id in facts.cameras]
    columns = 1 if len(images) <= 3 else 2
    side = rrb.Grid(*images, grid_columns=columns) if len(images) > 1 else images[0]
    return rrb.Horizontal(left, side, column_shares=[3, 2], name=facts.title)


def _world(facts: Facts, name: str, *, follows: bool) -> Any:
    """The world with the eye behind the ego; or, of a drive that moves, all of it, the eye where the viewer puts it."""
    rrb = blueprint_sdk()
    world = f"{facts.root}/{WORLD}"
    eye = {"position": facts.eye, "look_target": facts.target} if follows or not facts.follows else {}
    return rrb.Spatial3DView(
        origin=f"{world}/{EGO}" if follows else world,
        contents=f"+ {world}/**",
        name=name,
        background=_BACKGROUND,
        line_grid=not follows,
        eye_controls=rrb.EyeControls3D(kind=rrb.Eye3DKind.Orbital, **eye),
    )


def _named(container: Any, facts: Facts) -> Any:
    return blueprint_sdk().Horizontal(container, name=facts.title)


def _camera(facts: Facts, camera_id: Identifier) -> Any:
    """The images of a camera with what is drawn into them and what the camera model sees of the world.

    Its fused depths.
    """
    rrb = blueprint_sdk()
    path = f"{facts.root}/{WORLD}/{SENSORS}/{escaped(camera_id)}/{IMAGE}"
    through = [f"+ {facts.root}/{WORLD}/{name}/**" for name in _IN_IMAGES]
    images = rrb.Spatial2DView(
        origin=path, contents=["+ $origin/**", f"- $origin/{DEPTH}/**", *through], name=str(camera_id)
    )
    if not facts.depths:
        return images
    depths = rrb.Spatial2DView(origin=path, contents=[f"+ $origin/{DEPTH}/**"], name=f"{camera_id}: depth")
    return rrb.Tabs(images, depths, active_tab=0, name=str(camera_id))


def _tabs(facts: Facts) -> list[Any]:
    rrb = blueprint_sdk()
    root = facts.root
    views = [
        rrb.TextLogView(origin=root, contents=[f"+ {root}/{NOTES}", f"+ {root}/{EVENTS}/**"], name="log")
    ]
    if facts.gnss:
        views.append(rrb.TimeSeriesView(origin=f"{root}/{GNSS}", name="satellite fixes"))
    for sensor_id, streams in facts.curves:
        plots = [
            rrb.TimeSeriesView(origin=f"{root}/{IMU}/{escaped(sensor_id)}/{escaped(name)}", name=name)
            for name in streams
        ]
        views.append(rrb.Horizontal(*plots, name=str(sensor_id)))
    if facts.plan:
        views.append(rrb.Spatial2DView(origin=f"{root}/{MAP}", name="map [m]", background=_BACKGROUND))
    if facts.earth:
        views.append(
            rrb.MapView(origin=f"{root}/{EARTH}", name="map", background=rrb.MapProvider.OpenStreetMap)
        )
    if facts.events:
        views.append(rrb.StateTimelineView(origin=f"{root}/{EVENTS}", name="events"))
    if facts.attributes:
        views.append(rrb.TimeSeriesView(origin=f"{root}/{ATTRIBUTES}", name="attributes"))
        views.append(rrb.StateTimelineView(origin=f"{root}/{ATTRIBUTES}", name="attributes in words"))
    if facts.listed:
        views.append(rrb.TextDocumentView(origin=f"{root}/{LIST}", name="annotations"))
    if facts.relations:
        views.append(rrb.GraphView(origin=f"{root}/{RELATIONS}", name="relations"))
    return views
