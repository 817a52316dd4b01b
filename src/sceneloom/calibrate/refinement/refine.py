"""A calibration refined over many frames at once, and taken only where frames that took no part agree."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.calibrate.frames import CalibrationFrame
from sceneloom.calibrate.measures.candidate import UNITS, Change, Parameter
from sceneloom.calibrate.refinement.cues import Cues, find_cues
from sceneloom.calibrate.refinement.judging import LEAST_VIEWS, LOOSEST, held_out_gain, judged, sharpness_of
from sceneloom.calibrate.refinement.moving_pixels import focused
from sceneloom.calibrate.refinement.objective import WIDTHS_PX, Level
from sceneloom.calibrate.refinement.results import GROUPS, Refinement, RefinementVerdict
from sceneloom.calibrate.refinement.search import Found, search
from sceneloom.calibrate.refinement.uncertainty import covariance_of
from sceneloom.calibrate.refinement.views import views_of
from sceneloom.errors import CalibrationError, OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.types import Progress

Result = TypeVar("Result")

DEFAULT = ("rotation", "translation", "time")
LEAST_FRAMES = 4
_FOLDS = 3
_LEAST_CUES = 150
"""A frame with fewer points around its image is not used."""


def refine(
    frames: Sequence[CalibrationFrame],
    *,
    parameters: Sequence[str] = DEFAULT,
    progress: Progress | None = None,
) -> Refinement:
    """Refine the calibration of a camera against a lidar by frames of a drive.

    Args:
        frames: of one camera and one lidar, all with the same stated calibration.
        parameters: names out of `GROUPS`; "rotation" is always among what is refined.
        progress: reported how many of the steps are done.

    Raises:
        OptionError: a parameter is unknown.
    """
    groups = _groups(parameters)
    if len(frames) < LEAST_FRAMES:
        return _unable(
            frames, f"{len(frames)} frames; expected {LEAST_FRAMES} or more, to refine and to judge by"
        )
    reported = _Reported(progress, len(frames) + len(WIDTHS_PX) + 2 + _FOLDS)
    cues = tuple(
        one for frame in frames if len((one := reported.after(find_cues(frame))).weights) >= _LEAST_CUES
    )
    problem = _why_not(frames, cues)
    if problem:
        return _unable(frames, problem)
    levels = tuple(reported.after(Level.of(cues, width)) for width in WIDTHS_PX)
    return _refined(_Drive(cues, levels, views_of([one.frame for one in cues])), groups, reported)


def _groups(parameters: Sequence[str]) -> tuple[str, ...]:
    unknown = [name for name in parameters if name not in GROUPS]
    if unknown or not parameters:
        raise OptionError(f"parameters {', '.join(unknown) or 'none'}; expected some of {', '.join(GROUPS)}")
    return tuple(name for name in GROUPS if name == "rotation" or name in parameters)


@dataclass(slots=True)
class _Reported:
    """Counts what is done."""

    progress: Progress | None
    whole: int
    done: int = 0

    def after(self, result: Result) -> Result:
        """Report that something more is done."""
        self.done = min(self.done + 1, self.whole)
        if self.progress is not None:
            self.progress(self.done, self.whole)
        return result


@dataclass(frozen=True, slots=True, eq=False)
class _Drive:
    cues: tuple[Cues, ...]
    levels: tuple[Level, ...]
    views: Int64Array

    @property
    def all_frames(self) -> BoolArray:
        return np.ones(len(self.cues), np.bool_)

    @property
    def folds(self) -> list[BoolArray]:
        """Frames that are held out together: stretches of the drive, whole views where there are enough."""
        whole = self.views if self.views[-1] + 1 >= _FOLDS else np.arange(len(self.cues))
        return [whole * _FOLDS // (int(whole[-1]) + 1) == fold for fold in range(_FOLDS)]


def _why_not(frames: Sequence[CalibrationFrame], cues: Sequence[Cues]) -> str:
    """What speaks against even trying; "" for nothing."""
    if len(cues) < LEAST_FRAMES:
        return (
            f"the camera sees enough of the cloud in {len(cues)} of {len(frames)} frames; expected {LEAST_FRAMES}: "
            "does it look where the calibration says, and does the lidar see there?"
        )
    cameras = {(one.frame.camera.width, one.frame.camera.height, one.frame.camera.fx) for one in cues}
    if len(cameras) > 1:
        return "the camera model differs from image to image; expected one that is the same in all"
    if float(np.median([one.features.image.plainness for one in cues])) > 0.97:
        return "the images show next to nothing: black, covered or overexposed; expected edges to go by"
    return ""


def _unable(frames: Sequence[CalibrationFrame], reason: str) -> Refinement:
    if not frames:
        raise CalibrationError("no frames to refine a calibration by; expected some")
    return Refinement(
        RefinementVerdict.UNDETERMINED,
        reason,
        frames[0].camera_from_lidar,
        frames[0].camera,
        frames=len(frames),
    )


def _refined(drive: _Drive, groups: tuple[str, ...], reported: _Reported) -> Refinement:
    found, covariance, groups, held = _best(drive, groups, reported)
    gains = tuple(reported.after(held_out_gain(drive.levels, fold, found.free)) for fold in drive.folds)
    sharpness = sharpness_of(found)
    verdict, reason = judged(found, covariance, gains, sharpness)
    stated = drive.cues[0].frame
    change = Change.of(found.numbers)
    scale = UNITS[found.free]
    taken = change if verdict is RefinementVerdict.REFINED else Change()
    matrix = taken.camera_from_lidar(stated.camera_from_lidar.matrix)
    return Refinement(
        verdict,
        reason,
        RigidTransform.nearest(matrix)[0],
        focused(stated.camera, taken.numbers[Parameter.FOCAL]),
        taken.numbers[Parameter.LATER],
        change,
        groups,
        held,
        found.free,
        covariance * np.outer(scale, scale),
        gains,
        sharpness,
        len(drive.cues),
        int(drive.views[-1]) + 1,
    )


def _best(
    drive: _Drive, groups: tuple[str, ...], reported: _Reported
) -> tuple[Found, Float64Array, tuple[str, ...], tuple[str, ...]]:
    """Search for all groups, and again without those that the drive does not report."""
    held: list[str] = []
    count = int(drive.views[-1]) + 1
    if count < LEAST_VIEWS:
        held = [
            f"{name}: {count} views; expected {LEAST_VIEWS} or more" for name in groups if name != "rotation"
        ]
        groups = ("rotation",)
    while True:
        free = np.array([int(parameter) for name in groups for parameter in GROUPS[name]], np.int64)
        found = reported.after(search(drive.levels, drive.all_frames, free))
        covariance = covariance_of(found, drive.views)
        sigmas = _sigmas(found.free, covariance, groups)
        loose = {
            name: sigma for name, sigma in sigmas.items() if sigma > LOOSEST[name] and name != "rotation"
        }
        if not loose:
            return found, covariance, groups, tuple(held)
        held += [f"{name}: known within {_worded(name, sigma)} only" for name, sigma in loose.items()]
        groups = tuple(name for name in groups if name not in loose)


def _sigmas(free: Int64Array, covariance: Float64Array, groups: Sequence[str]) -> dict[str, float]:
    """The largest standard deviation of each group."""
    roots = np.sqrt(np.diagonal(covariance)) * UNITS[free]
    return {name: max(float(roots[free == int(k)][0]) for k in GROUPS[name]) for name in groups}


def _worded(name: str, sigma: float) -> str:
    scale, unit = {
        "rotation": (np.degrees(1.0), "deg"),
        "translation": (100.0, "cm"),
        "time": (1e3, "ms"),
    }.get(name, (100.0, "%"))
    return f"{sigma * scale:.2g} {unit}"
