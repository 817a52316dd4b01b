"""Rules about poses that do not agree with the IMU: gravity, turning, clocks."""

from collections.abc import Iterator

import numpy as np

from sceneloom.checks.recordings.exchanged_axes import axes_in_words, best_axes
from sceneloom.checks.recordings.pose_verdicts import (
    GREATEST_TILT_DEG,
    LEAST_COHERENCE,
    LEAST_CORRELATION,
    PoseVerdict,
    pose_verdicts,
)
from sceneloom.checks.rule import Hit, Rule
from sceneloom.checks.subject import Subject
from sceneloom.scene import Severity

_SHIFT_TOLD = 0.05
"""Shorter shifts between poses and IMU [s] are for `sceneloom sync` to find."""
_SURE = 0.9
_SCALES = (0.6, 1.6)
_DEGREES = float(np.degrees(1.0))
_NEAR_DEGREES = 0.2
_OWN_AXES = np.eye(3)


def _gravity(subject: Subject) -> Iterator[Hit]:
    for verdict in pose_verdicts(subject):
        given = verdict.given
        if given.stands_upright or given.up is None:
            continue
        x, y, z = given.up / given.coherence
        told = (
            f"the accelerometer's mean, turned into the world, points to {x:.2f}, {y:.2f}, {z:.2f}, "
            f"{given.tilt_deg:.0f}° off up, and is {given.coherence:.0%} as long as in the device; expected 0, 0, 1 "
            f"within {GREATEST_TILT_DEG:.0f}°, and {LEAST_COHERENCE:.0%} or more"
        )
        yield Hit(_place(verdict), f"{told}{_reason(verdict) or _reason_of_tilt(verdict)}")


def _reason(verdict: PoseVerdict) -> str:
    return f": probably {verdict.probably}" if verdict.probably else ""


def _reason_of_tilt(verdict: PoseVerdict) -> str:
    given = verdict.given
    if given.turns_alike and given.coherence > _SURE:
        return ": probably the accelerometer's axes are not the gyroscope's, or the world is not level"
    return ""


def _turning(subject: Subject) -> Iterator[Hit]:
    for verdict in pose_verdicts(subject):
        if verdict.given.turns_alike:
            continue
        found = float(verdict.given.correlations[len(verdict.shifts) // 2])
        told = (
            f"turn rates of the orientations and of the gyroscope correlate by {found:.2f}; "
            f"expected at least {LEAST_CORRELATION}"
        )
        yield Hit(_place(verdict), f"{told}{_reason(verdict) or _reason_of_axes(verdict)}")


def _reason_of_axes(verdict: PoseVerdict) -> str:
    if not verdict.told.any():
        return ": the orientations do not turn"
    axes, score = best_axes(verdict.measured, verdict.told)
    if score < LEAST_CORRELATION or np.array_equal(axes, _OWN_AXES):
        return ""
    return f": probably the gyroscope's axes x, y, z are {axes_in_words(axes)} of the poses' device"


def _scale(subject: Subject) -> Iterator[Hit]:
    for verdict in pose_verdicts(subject):
        if not verdict.told.any() or not verdict.given.correlation > _SURE:
            continue
        scale = float(np.sqrt((verdict.measured**2).sum() / (verdict.told**2).sum()))
        if not _SCALES[0] <= scale <= _SCALES[1]:
            hint = ": probably degrees per second" if abs(scale / _DEGREES - 1) < _NEAR_DEGREES else ""
            told = (
                f"the gyroscope turns {scale:.3g} times as fast as the orientations of {verdict.name!r}{hint}"
            )
            yield Hit("sensors[imu].streams.gyroscope", told)


def _clocks(subject: Subject) -> Iterator[Hit]:
    for verdict in pose_verdicts(subject):
        correlations = verdict.given.correlations if verdict.better is None else verdict.better
        if not len(correlations) or len(verdict.shifts) < 3:
            continue
        best = int(correlations.argmax())
        shift, now = float(verdict.shifts[best]), float(correlations[len(correlations) // 2])
        is_better = correlations[best] > _SURE and 1.0 - correlations[best] < 0.5 * (1.0 - now)
        if abs(shift) > max(_SHIFT_TOLD, verdict.tolerance) and is_better:
            later = "later" if shift > 0 else "earlier"
            at_least = "at least " if best in {0, len(correlations) - 1} else ""
            told = (
                f"turn rates agree best ({correlations[best]:.3f} in place of {now:.3f}) if the IMU's times are "
                f"{at_least}{abs(shift):.2f} s {later} than those of the poses"
            )
            yield Hit(_place(verdict), told)


def _place(verdict: PoseVerdict) -> str:
    return f"trajectories[{verdict.name}]"


RULES: tuple[Rule, ...] = (
    Rule(
        "poses-against-gravity",
        Severity.WARNING,
        f"What the accelerometer measures points up in the world of the poses, within {GREATEST_TILT_DEG:.0f}°.",
        "Write poses as device to world, quaternions as x, y, z, w, in a world whose z points up.",
        find=_gravity,
    ),
    Rule(
        "poses-against-gyroscope",
        Severity.WARNING,
        f"Orientations turn as the gyroscope measures: their rates correlate by {LEAST_CORRELATION} or more.",
        "Write poses as device to world, of the IMU's own axes, in a right-handed world.",
        find=_turning,
    ),
    Rule(
        "gyroscope-scale",
        Severity.WARNING,
        f"The gyroscope turns {_SCALES[0]} to {_SCALES[1]} times as fast as the orientations.",
        "Write radians per second.",
        find=_scale,
    ),
    Rule(
        "poses-clock",
        Severity.WARNING,
        f"Orientations turn at the time at which the gyroscope does, within {_SHIFT_TOLD} s.",
        "Find the offset with `sceneloom sync`, and bring both to one clock.",
        find=_clocks,
    ),
)
