"""The ego trajectory, and what IMU and satellite receivers state, as curves and maps."""

from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.geometry.geodesy import enu_from_geodetic, geodetic_from_enu
from sceneloom.motion.ego_trajectory import usable_fixes, usable_positions
from sceneloom.scene.motion import GnssSensor, ImuSensor, VectorSamples
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Scene
from sceneloom.view.points import WORLD, one_packed
from sceneloom.view.poses import Locations, transform_columns
from sceneloom.view.stream import Stream, fits, sdk
from sceneloom.visualization.canvas import Colour
from sceneloom.visualization.figures import colour_of_name

EGO, TRAJECTORIES, IMU, GNSS, MAP, EARTH = "ego", "trajectories", "imu", "gnss", "map", "earth"
"""Entities: the ego's frame, ways through the world, curves of both kinds of sensors, the plan, locations on earth."""
_AXES = ("x", "y", "z")
_UNITS: Mapping[str, str] = MappingProxyType(
    {"accelerometer": "m/s²", "gyroscope": "rad/s", "magnetometer": "µT", "imuTemperature": "K", "barometer": "hPa"}
)
_AXIS_COLOURS = ((239, 83, 80), (102, 187, 106), (66, 165, 245))
_TRAJECTORY, _FIXES = (255, 206, 84), (82, 196, 255)
_MOST_POSES = 20_000
_ROWS_AT_ONCE = 8_192
_MOST_SAMPLES = 200_000


def show_motion(stream: Stream, locations: Locations, scene: Scene) -> None:
    """Show the ego trajectory, IMU and GNSS; all of it at once, since it is small."""
    stream.static(stream.path(WORLD), sdk().ViewCoordinates.RIGHT_HAND_Z_UP)
    _show_ego(stream, locations)
    imus = [sensor for sensor in scene.sensors if isinstance(sensor, ImuSensor)]
    receivers = [sensor for sensor in scene.sensors if isinstance(sensor, GnssSensor)]
    receivers = [sensor for sensor in receivers if len(sensor.timestamps_ns)]
    for imu in imus:
        _show_imu(stream, imu)
    for receiver in receivers:
        _show_fixes(stream, receiver)
    origin_lla = _map_origin(locations, receivers)
    _show_plan(stream, locations, receivers, origin_lla)


def _show_ego(stream: Stream, locations: Locations) -> None:
    rr, path = sdk(), locations.path
    for name, trajectory in locations.scene.trajectories.items():
        if locations.ego is not None and name == locations.ego.name and path is not None:
            continue  # it is the ego trajectory, drawn below
        shifted = trajectory.positions - locations.origin_world
        line = _line(shifted)
        stream.leave_out("poses", np.count_nonzero(~fits(shifted)))
        stream.static(stream.path(WORLD, TRAJECTORIES, name), _strips(line, colour_of_name(name), name))
    if path is None:
        return
    rows = _thinned(len(path.timestamps_ns), _MOST_POSES)
    samples = path.moved(locations.origin_world).held(path.timestamps_ns[rows])
    held = fits(samples.positions)
    stream.leave_out("ego poses", np.count_nonzero(~held))
    entity, shown = stream.path(WORLD, EGO), np.flatnonzero(held)
    stream.columns(path.timestamps_ns[rows][shown], entity, transform_columns(samples, shown), kind="ego poses")
    stream.static(entity, rr.TransformAxes3D(1.5))
    stream.static(
        stream.path(WORLD, TRAJECTORIES, _trajectory_name(locations)),
        _strips(samples.positions[shown], _TRAJECTORY, _trajectory_name(locations)),
    )


def _trajectory_name(locations: Locations) -> str:
    return "ego" if locations.ego is None else locations.ego.name


def _strips(line: Float64Array, colour: Colour, name: str) -> object:
    return sdk().LineStrips3D(
        [line],
        colors=np.array([one_packed(colour)], np.uint32),
        radii=np.array([-1.5], np.float32),
        labels=[name],
        show_labels=False,
    )


def _line(positions: Float64Array) -> Float64Array:
    finite = positions[fits(positions)]
    return np.asarray(finite[_thinned(len(finite), _MOST_POSES)], np.float64)


def _thinned(count: int, most: int) -> np.ndarray:
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.int64))


def _show_imu(stream: Stream, sensor: ImuSensor) -> None:
    for name, samples in sensor.streams.items():
        width = samples.values.shape[1]
        axes = [_AXES[k] if width == 3 else (name if width == 1 else str(k)) for k in range(width)]
        _curves(stream, stream.path(IMU, sensor.id, name), samples, axes, _UNITS.get(name, ""))


def _curves(
    stream: Stream,
    path: str,
    samples: VectorSamples,
    names: Iterable[str],
    unit: str,
    *,
    colours: Sequence[Colour] = _AXIS_COLOURS,
) -> None:
    """Log a vector over time; of very long streams every Nth sample."""
    rr = sdk()
    titles = [f"{name} [{unit}]" if unit else name for name in names]
    chosen = [colours[k % len(colours)] for k in range(len(titles))]
    stream.static(path, rr.SeriesLines(names=titles, colors=chosen))
    step = -(-len(samples) // _MOST_SAMPLES) or 1
    times_ns, values = samples.timestamps_ns[::step], samples.values[::step]
    for start in range(0, len(times_ns), _ROWS_AT_ONCE):
        part = slice(start, start + _ROWS_AT_ONCE)
        rows = values[part]
        columns = rr.Scalars.columns(scalars=rows.reshape(-1)).partition(np.full(len(rows), rows.shape[1]))
        stream.columns(times_ns[part], path, columns, kind="samples")


def _show_fixes(stream: Stream, sensor: GnssSensor) -> None:
    """Log fixes as locations on earth, and their heights and accuracies as curves."""
    rr = sdk()
    usable = usable_fixes(sensor)
    times_ns, lla = sensor.timestamps_ns[usable], sensor.positions_lla[usable]
    colour = one_packed(_FIXES)
    points = rr.GeoPoints.columns(
        positions=lla[:, :2], radii=np.full(len(lla), -6.0, np.float32), colors=np.full(len(lla), colour, np.uint32)
    )
    stream.columns(times_ns, stream.path(EARTH, sensor.id, "fix"), points, kind="fixes")
    trajectory = rr.GeoLineStrings(
        lat_lon=[lla[:, :2]], colors=np.array([colour], np.uint32), radii=np.array([-1.5], np.float32)
    )
    stream.static(stream.path(EARTH, sensor.id, "trajectory"), trajectory)
    curves = (
        ("height", lla[:, 2], _AXIS_COLOURS[2]),
        ("accuracy", sensor.accuracies[usable], _AXIS_COLOURS[0]),
        ("vertical accuracy", sensor.vertical_accuracies[usable], _AXIS_COLOURS[1]),
    )
    for name, values, curve in curves:
        known = np.isfinite(values)
        if known.any():
            samples = VectorSamples(times_ns[known], np.ascontiguousarray(values[known, None]))
            _curves(stream, stream.path(GNSS, sensor.id, name), samples, [name], "m", colours=(curve,))


def _map_origin(locations: Locations, receivers: list[GnssSensor]) -> Float64Array | None:
    """The location on earth that the plan counts from: the world's origin where it is known, else the first fix."""
    if locations.ego is not None and locations.ego.enu_origin_lla is not None:
        return np.array(locations.ego.enu_origin_lla)
    if not receivers:
        return None
    _, fixes = usable_positions(receivers[0])
    return fixes[0] if len(fixes) else None


def _show_plan(
    stream: Stream, locations: Locations, receivers: list[GnssSensor], origin_lla: Float64Array | None
) -> None:
    """Log a plan in metres, north (or the world's y) up: fixes, and the ego trajectory where both share their axes."""
    if origin_lla is not None:
        for sensor in receivers:
            rows, fixes = usable_positions(sensor)
            enu = enu_from_geodetic(fixes, origin_lla)
            _plan_line(stream, (GNSS, sensor.id), enu, _FIXES)
            _plan_marks(stream, (GNSS, sensor.id), sensor.timestamps_ns[rows], enu, _FIXES)
    is_enu = locations.ego is not None and locations.ego.enu_origin_lla is not None
    if locations.path is not None and (is_enu or origin_lla is None):
        positions = locations.path.positions if is_enu else locations.path.positions - locations.origin_world
        _plan_line(stream, (EGO,), positions, _TRAJECTORY)
        _plan_marks(stream, (EGO,), locations.path.timestamps_ns, positions, _TRAJECTORY)
        if is_enu and origin_lla is not None:
            _show_trajectory_on_earth(stream, locations.path, origin_lla)


def _plan_line(stream: Stream, names: tuple[str | int, ...], enu: Float64Array, colour: Colour) -> None:
    strip = _on_plan(_line(enu))
    line = sdk().LineStrips2D(
        [strip], colors=np.array([one_packed(colour)], np.uint32), radii=np.array([-1.0], np.float32)
    )
    stream.static(stream.path(MAP, *names, "trajectory"), line)


def _plan_marks(
    stream: Stream, names: tuple[str | int, ...], times_ns: np.ndarray, enu: Float64Array, colour: Colour
) -> None:
    rows = _thinned(len(enu), _MOST_POSES)
    marks = sdk().Points2D.columns(
        positions=_on_plan(enu[rows]),
        colors=np.full(len(rows), one_packed(colour), np.uint32),
        radii=np.full(len(rows), -5.0, np.float32),
    )
    stream.columns(times_ns[rows], stream.path(MAP, *names, "location"), marks)


def _on_plan(enu: Float64Array) -> Float64Array:
    """East and north as pixels, which count downwards."""
    return enu[:, :2] * (1.0, -1.0)


def _show_trajectory_on_earth(stream: Stream, path: Poses, origin_lla: Float64Array) -> None:
    lla = geodetic_from_enu(_line(path.positions), origin_lla)
    trajectory = sdk().GeoLineStrings(
        lat_lon=[lla[:, :2]], colors=np.array([one_packed(_TRAJECTORY)], np.uint32), radii=np.array([-1.5], np.float32)
    )
    stream.static(stream.path(EARTH, EGO), trajectory)
