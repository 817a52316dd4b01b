"""Rules about the points of lidars and radars: locations, intensities and colours that sensors give."""

from collections.abc import Iterator

import numpy as np

from sceneloom.arrays import Float32Array
from sceneloom.checks.cloud_facts import FAR_M, SensorFacts, cloud_facts, sensor_facts
from sceneloom.checks.rule import Hit, Rule
from sceneloom.checks.subject import FrameInHand, Subject
from sceneloom.scene.clouds import LidarFrame, PointsSensor, RadarFrame
from sceneloom.scene.findings import Severity

_ORIGIN_SHARE = 0.05
_ENOUGH_POINTS = 100
"""Of fewer points nothing is stated."""

_COLLAPSED_SHARE = 0.1
_FEW_LEVELS = 4
_CLIPPED_SHARE = 0.5
_NO_CAMERA = 255
_NORM_TOLERANCE = 0.01
_FASTEST = 150.0
"""Relative to the sensor: two vehicles that meet on a motorway [m/s]."""


def _not_finite(subject: Subject, frame: FrameInHand) -> Iterator[Hit]:
    facts = cloud_facts(subject, frame)
    if facts is not None and facts.not_finite:
        message = f"{facts.not_finite} of {facts.count} points have a location that is not finite"
        yield Hit(f"{frame.path}.points.positions", message, count=facts.not_finite)


def _at_origin(subject: Subject, frame: FrameInHand) -> Iterator[Hit]:
    facts = cloud_facts(subject, frame)
    if facts is not None and facts.at_origin > max(1, _ORIGIN_SHARE * facts.count):
        message = f"{facts.at_origin} of {facts.count} points lie at 0, 0, 0"
        yield Hit(f"{frame.path}.points.positions", message, count=facts.at_origin)


def _far(subject: Subject, frame: FrameInHand) -> Iterator[Hit]:
    facts = cloud_facts(subject, frame)
    if facts is not None and facts.far:
        step_mm = float(np.spacing(np.float32(facts.farthest))) * 1e3
        message = f"coordinates up to {facts.farthest:.0f} m, where float32 steps by {step_mm:.2g} mm"
        yield Hit(f"{frame.path}.points.positions", message, count=facts.far)


def _map_not_finite(subject: Subject) -> Iterator[Hit]:
    for path, positions in _maps(subject):
        bad = int(np.count_nonzero(~np.isfinite(positions).all(axis=1)))
        if bad:
            message = f"{bad} of {len(positions)} points have a location that is not finite"
            yield Hit(f"{path}.points.positions", message, count=bad)


def _map_far(subject: Subject) -> Iterator[Hit]:
    for path, positions in _maps(subject):
        far = positions[np.isfinite(positions) & (np.abs(positions) > FAR_M)]
        if len(far):
            message = f"coordinates up to {np.abs(far).max():.0f} m, too far for float32"
            yield Hit(f"{path}.points.positions", message)


def _maps(subject: Subject) -> Iterator[tuple[str, Float32Array]]:
    for path, sensor in subject.sensors():
        if isinstance(sensor, PointsSensor):
            yield path, sensor.positions


def _seen(subject: Subject, frame: FrameInHand) -> Iterator[Hit]:
    """Take the frame in; what it shows together with the others is stated at the end."""
    cloud_facts(subject, frame)
    yield from ()


def _without_points(subject: Subject) -> Iterator[Hit]:
    for facts in sensor_facts(subject).values():
        empty = [number for number, count in zip(facts.numbers, facts.counts, strict=True) if count == 0]
        if empty:
            message = f"{len(empty)} of {len(facts.counts)} frames have no points"
            yield Hit(f"{facts.path}.frames[{empty[0]}]", message, count=len(empty))


def _collapsed(subject: Subject) -> Iterator[Hit]:
    for facts in sensor_facts(subject).values():
        usual = float(np.median(facts.counts))
        few = [
            (number, count)
            for number, count in zip(facts.numbers, facts.counts, strict=True)
            if 0 < count < _COLLAPSED_SHARE * usual
        ]
        if few and usual >= _ENOUGH_POINTS:
            number, count = few[0]
            message = f"{count} points; the sensor's frames have {usual:.0f} in the middle"
            yield Hit(f"{facts.path}.frames[{number}].points", message, count=len(few))


def _repeated(subject: Subject) -> Iterator[Hit]:
    for facts in sensor_facts(subject).values():
        if facts.repeated:
            message = (
                f"{len(facts.repeated)} of {len(facts.counts)} frames have the very points of the one before"
            )
            yield Hit(f"{facts.path}.frames[{facts.repeated[0]}]", message, count=len(facts.repeated))


def _odd_intensities(subject: Subject) -> Iterator[Hit]:
    for facts in sensor_facts(subject).values():
        reported = _reported_intensities(facts)
        if reported is not None:
            yield Hit(f"{facts.path}.frames[].points.intensities", reported, count=len(facts.counts))


def _reported_intensities(facts: SensorFacts) -> str | None:
    levels = facts.levels
    if levels is None or levels.sum() < _ENOUGH_POINTS:
        return None
    used = np.flatnonzero(levels)
    if len(used) == 1:
        return f"all are {used[0]}"
    if used[-1] <= 1:
        return "all are 0 or 1: numbers from 0 to 1 were rounded to integers"
    if len(used) <= _FEW_LEVELS:
        return f"only {len(used)} levels: {', '.join(map(str, used.tolist()))}"
    clipped = levels[255] / levels.sum()
    return f"{clipped:.0%} are 255: they were cut off" if clipped > _CLIPPED_SHARE else None


def _all_one_colour(subject: Subject) -> Iterator[Hit]:
    for facts in sensor_facts(subject).values():
        if facts.coloured < _ENOUGH_POINTS:
            continue
        for name, count in (("white", facts.white), ("black", facts.black)):
            if count == facts.coloured:
                yield Hit(f"{facts.path}.frames[].points.colors", f"all {count} points are {name}")


def _unknown_camera(subject: Subject, frame: FrameInHand) -> Iterator[Hit]:
    points = frame.frame.points if isinstance(frame.frame, LidarFrame) else None
    if points is None or points.camera_index is None:
        return
    cameras = len(subject.scene.cameras)
    unknown = points.camera_index[(points.camera_index >= cameras) & (points.camera_index != _NO_CAMERA)]
    if len(unknown):
        message = f"camera {unknown[0]}; the scene has {cameras} cameras, counted from 0"
        yield Hit(f"{frame.path}.points.camera_index", message, count=len(unknown))


def _no_unit_vectors(subject: Subject, frame: FrameInHand) -> Iterator[Hit]:
    del subject
    points = frame.frame.points if isinstance(frame.frame, RadarFrame) else None
    if points is None or points.directions is None:
        return
    norms = np.linalg.norm(points.directions, axis=1)
    off = np.flatnonzero(~(np.abs(norms - 1.0) <= _NORM_TOLERANCE))
    if len(off):
        message = f"length {norms[off[0]]:.4g}; expected 1"
        yield Hit(f"{frame.path}.points.directions[{off[0]}]", message, count=len(off))


def _absurd_speeds(subject: Subject, frame: FrameInHand) -> Iterator[Hit]:
    del subject
    points = frame.frame.points if isinstance(frame.frame, RadarFrame) else None
    if points is None or points.lengths is None:
        return
    off = np.flatnonzero(~(np.abs(points.lengths) <= _FASTEST))
    if len(off):
        message = f"{points.lengths[off[0]]:g} m/s; expected at most {_FASTEST:g} either way"
        yield Hit(f"{frame.path}.points.lengths[{off[0]}]", message, count=len(off))


RULES: tuple[Rule, ...] = (
    Rule(
        "points-not-finite",
        Severity.WARNING,
        "The location of every point is finite.",
        "Leave points without a location out.",
        find=_map_not_finite,
        look=_not_finite,
    ),
    Rule(
        "points-at-origin",
        Severity.WARNING,
        f"No more than {_ORIGIN_SHARE:.0%} of a frame's points lie exactly at the origin.",
        "Leave out the beams that did not return.",
        look=_at_origin,
    ),
    Rule(
        "points-far",
        Severity.WARNING,
        f"Points lie within {FAR_M / 1000:g} km of the origin, where float32 reports millimetres.",
        "Choose an origin near the drive, as `sceneloom fuse` does, and keep the way to it in the metadata.",
        find=_map_far,
        look=_far,
    ),
    Rule(
        "frame-without-points",
        Severity.HINT,
        "Every frame has points.",
        "Look whether the sensor was off, or its packets were lost.",
        look=_seen,
        conclude=_without_points,
    ),
    Rule(
        "frame-repeated",
        Severity.HINT,
        "No frame has the very points of the frame before it.",
        "Look whether the sensor hung, or frames were filled in.",
        look=_seen,
        conclude=_repeated,
    ),
    Rule(
        "point-count-collapses",
        Severity.WARNING,
        f"No frame has fewer points than {_COLLAPSED_SHARE:.0%} of the sensor's usual number.",
        "Look whether packets were lost.",
        look=_seen,
        conclude=_collapsed,
    ),
    Rule(
        "intensity-scale",
        Severity.WARNING,
        "Intensities use the range from 0 to 255.",
        "Scale them to 0 to 255 before they become integers.",
        look=_seen,
        conclude=_odd_intensities,
    ),
    Rule(
        "colors-all-alike",
        Severity.WARNING,
        "The points of a sensor are not all white, and not all black.",
        "Leave `colors` out where no camera coloured the points, or look why none did.",
        look=_seen,
        conclude=_all_one_colour,
    ),
    Rule(
        "camera-index-unknown",
        Severity.ERROR,
        "The camera that coloured a point is a camera of the scene; 255 stands for none.",
        "Colour the points again: cameras were added or taken out since.",
        look=_unknown_camera,
    ),
    Rule(
        "radar-direction-norm",
        Severity.WARNING,
        "The directions of radar points are unit vectors.",
        "Divide each by its length.",
        look=_no_unit_vectors,
    ),
    Rule(
        "radar-length-absurd",
        Severity.WARNING,
        f"The lengths of radar points are speeds up to {_FASTEST:g} m/s.",
        "Give metres per second along `directions`.",
        look=_absurd_speeds,
    ),
)
