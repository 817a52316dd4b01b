"""The check of a calibration: are images and sweeps of a drive where it says that they are?"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import msgspec
import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.calibrate.frames import MOST, CalibrationFrame, calibration_frames
from sceneloom.calibrate.health.objective import Objective
from sceneloom.calibrate.health.principal_point import instead_of_rotation, why_untold
from sceneloom.calibrate.health.search import GROUPS, Top, find_group, find_rotation
from sceneloom.calibrate.health.verdicts import Item, Verdict, judge
from sceneloom.calibrate.measures.agreement import MEASURES, Agreement
from sceneloom.calibrate.measures.candidate import COUNT, Change
from sceneloom.calibrate.measures.features import FrameFeatures
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier
from sceneloom.scene.warnings import DataWarning

DISTINCT = 4.5
"""Deviations above chance from which on images and sweeps agree; the best of some hundred chances reaches 3.3."""

PARTS = ("rotation", "translation", "focal_length", "principal_point", "time_offset")
"""What images and points are asked about, in the order of the items."""

_OWN_VIEW_M, _OWN_VIEW_DEG = 4.0, 15.0
_LEAST_SEEN, _LEAST_EDGES = 200, 60
_PLAIN = 0.9
"""Images of which more shows nothing are dark, covered or fogged."""
_BETTER, _BETTER_SIGMAS = 1.0, 3.0
"""A part counts as off only if changing it, too, makes images and sweeps agree better by this."""
_ALIKE = 0.8
"""A good calibration stands so high, as part of the height of the best one. On simulated drives true ones stand at 0.9
and more, those half a degree or 15 cm off below 0.5."""
_LEAST_SPEED, _LEAST_ROTATION = 1.0, 0.03
"""Slower than this [m/s, rad/s] nothing reports when an image was taken."""


class CalibrationHealth(msgspec.Struct, frozen=True, kw_only=True):
    """What a drive says of a calibration.

    Attributes:
        source: the drive.
        camera_id, lidar_id: whose calibration.
        verdict: of all of it: that of the worst part. Cannot report where the rotation cannot be reported, or where
            another part seems to be off but that may be chance, or where the stated one agrees clearly less than the
            best one.
        items: by part; with boxes of detectors two more, of the rotation that these show.
        frames: images that were looked at.
        views: how many different views they show.
        distinctness: how far the best calibration around stands above chance, in chance's own deviations.
        stated_distinctness: the same of the stated one.
        measures: how far each measure stands above chance, under the stated calibration and under the best one.
        change: what leads from the stated calibration to the best one, as `Change.numbers`; zeros where that cannot be
            reported.
        corrections: what was made of the drive's corrections before; what is judged is what they leave.
    """

    source: str
    camera_id: Identifier
    lidar_id: Identifier
    verdict: Verdict
    items: tuple[Item, ...]
    frames: int
    views: int
    distinctness: float
    stated_distinctness: float
    measures: dict[str, tuple[float, float]]
    change: tuple[float, ...] = (0.0,) * COUNT
    corrections: tuple[DataWarning, ...] = ()

    def item(self, name: str) -> Item:
        """The part of that name."""
        return next(item for item in self.items if item.name == name)

    @property
    def doubted(self) -> bool:
        """Whether images and points agree much better elsewhere, where they report the rotation at all."""
        return bool(self.item("rotation").values) and self.stated_distinctness < _ALIKE * self.distinctness


def check_calibration(
    scene: Scene, camera_id: Identifier | None = None, lidar_id: Identifier | None = None, *, most: int = MOST
) -> CalibrationHealth:
    """Check how a camera is stated to lie to a lidar by what both show.

    Args:
        camera_id, lidar_id: None for the scene's first ones.
        most: images to look at, at most.

    Raises:
        OptionError: there is no such camera or lidar.
        PoseError: it is not known how the camera lies to the lidar.
        DataError: an image or a sweep cannot be read.
    """
    scene = scene.corrected()
    health = check_frames(calibration_frames(scene, camera_id, lidar_id, most), source=scene.source)
    return msgspec.structs.replace(health, corrections=scene.correction_warnings)


def check_frames(frames: Sequence[CalibrationFrame], *, source: str = "frames") -> CalibrationHealth:
    """Check a calibration by frames of one camera and one lidar."""
    views = views_of(frames)
    agreement = Agreement(frames, views)
    nothing = why_nothing(agreement.features)
    if nothing:
        return _untold(frames, views, source, nothing)
    objective = Objective(agreement)
    rotation = find_rotation(objective)
    if rotation.distinctness < DISTINCT:
        reason = (
            f"no calibration within 6 degrees makes images and sweeps agree better than by chance "
            f"({rotation.distinctness:.1f} deviations; expected {DISTINCT:g}): it is far off, or they show too little"
        )
        return _untold(frames, views, source, reason, objective, rotation)
    joint = {name: find_group(objective, rotation.change, group) for name, group in GROUPS.items()}
    found = _Found(frames, objective, rotation, joint)
    items, standings = found.items(), _standings(objective, found.best)
    return CalibrationHealth(
        source=source,
        camera_id=frames[0].camera_id,
        lidar_id=frames[0].lidar_id,
        verdict=_overall(items, standings),
        items=items,
        frames=len(frames),
        views=int(views.max()) + 1,
        **asdict(standings),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """All that was found, and what it means."""

    frames: Sequence[CalibrationFrame]
    objective: Objective
    rotation: Top
    joint: dict[str, Top]

    @property
    def best(self) -> Top:
        """The rotation alone, or together with what makes a difference."""
        better = [top for top in self.joint.values() if _is_better(top)]
        return max(better, key=lambda top: top.gain, default=self.rotation)

    def items(self) -> tuple[Item, ...]:
        """Judge all parts."""
        return (
            self._rotation(),
            self._joint("translation"),
            self._joint("focal_length"),
            Item.unknown("principal_point", why_untold(self.frames[0].camera)),
            self._time_offset(),
        )

    def _rotation(self) -> Item:
        best = self.best
        item = judge("rotation", best.change[:3], best.covariance[:3, :3])
        stated = self.objective.stationary(self.objective.agreement.score(Change()))[0]
        if item.verdict is Verdict.GOOD and best is self.rotation and stated < _ALIKE * best.height:
            reason = "images and sweeps agree much better a little away from it"
            return msgspec.structs.replace(item, verdict=Verdict.UNDETERMINED, reason=reason)
        if item.verdict in _WORST_FIRST:
            instead = instead_of_rotation(self.frames[0].camera, best.change[:3])
            return msgspec.structs.replace(
                item, reason=f"{item.reason}; {instead}" if instead else item.reason
            )
        return item

    def _joint(self, name: str) -> Item:
        top = self.joint[name]
        item = judge(name, top.change[list(top.parameters[3:])], top.covariance[3:, 3:])
        if item.verdict in {Verdict.DRIFTING, Verdict.WRONG} and not _is_better(top):
            reason = "a change of it does not make images and sweeps agree better"
            return msgspec.structs.replace(item, verdict=Verdict.UNDETERMINED, reason=reason)
        return item

    def _time_offset(self) -> Item:
        twists = [frame.twist_lidar for frame in self.frames if frame.twist_lidar is not None]
        if not twists:
            return Item.unknown("time_offset", "the ego's motion is not known")
        speed = max(float(np.linalg.norm(twist[3:])) for twist in twists)
        rotation = max(float(np.linalg.norm(twist[:3])) for twist in twists)
        if speed < _LEAST_SPEED and rotation < _LEAST_ROTATION:
            return Item.unknown(
                "time_offset", f"the ego hardly moved: {speed:.1f} m/s, {np.degrees(rotation):.1f} deg/s"
            )
        return self._joint("time_offset")


def _is_better(top: Top) -> bool:
    return top.gain > max(_BETTER, _BETTER_SIGMAS * top.gain_deviation)


def why_nothing(features: Sequence[FrameFeatures]) -> str:
    """Why frames cannot determine anything of a calibration; "" if they may."""
    if sum(f.seen for f in features) < _LEAST_SEEN:
        seen = sum(f.seen for f in features)
        return f"{seen} points fall into {len(features)} images; expected {_LEAST_SEEN} at least"
    if np.median([f.image.plainness for f in features]) > _PLAIN:
        return "the images show nothing: dark, covered or fogged"
    if sum(len(f.edge_weights) for f in features) < _LEAST_EDGES:
        return "the sweeps show hardly any edges where the camera looks"
    return ""


def views_of(frames: Sequence[CalibrationFrame]) -> Int64Array:
    """Number frames by what they show: those from nearly the same location count as one view, (F,)."""
    views = np.zeros(len(frames), np.int64)
    begun = frames[0].world_from_lidar
    for row, frame in enumerate(frames[1:], start=1):
        here = frame.world_from_lidar
        views[row] = views[row - 1]
        if here is None or begun is None:
            continue
        step = begun.inverse() @ here
        rotation = 2.0 * np.degrees(np.arccos(np.clip(step.quaternion_xyzw[3], -1.0, 1.0)))
        if np.linalg.norm(step.translation) > _OWN_VIEW_M or rotation > _OWN_VIEW_DEG:
            views[row], begun = views[row] + 1, here
    return views


_WORST_FIRST = (Verdict.WRONG, Verdict.DRIFTING)


def _overall(items: Sequence[Item], standings: "_Standings") -> Verdict:
    verdicts = {item.verdict for item in items}
    worst = next((verdict for verdict in _WORST_FIRST if verdict in verdicts), items[0].verdict)
    doubted = standings.stated_distinctness < _ALIKE * standings.distinctness
    if worst is Verdict.GOOD and (doubted or any(item.suspected for item in items)):
        return Verdict.UNDETERMINED
    return worst


@dataclass(frozen=True, slots=True)
class _Standings:
    """How far the stated and the best calibration stand above chance."""

    distinctness: float
    stated_distinctness: float
    measures: dict[str, tuple[float, float]]
    change: tuple[float, ...] = (0.0,) * COUNT


def _standings(objective: Objective, top: Top) -> _Standings:
    stated, best = (objective.agreement.score(change) for change in (Change(), Change.of(top.change)))
    pairs = zip(
        MEASURES,
        *(objective.deviations_of(score.values()[None])[0].tolist() for score in (stated, best)),
        strict=True,
    )
    return _Standings(
        objective.distinctness(best),
        objective.distinctness(stated),
        {name: (here, there) for name, here, there in pairs},
        tuple(top.change.tolist()),
    )


def _untold(
    frames: Sequence[CalibrationFrame],
    views: Int64Array,
    source: str,
    reason: str,
    objective: Objective | None = None,
    top: Top | None = None,
) -> CalibrationHealth:
    reported = _Standings(0.0, 0.0, {})
    if objective is not None and top is not None:
        reported = replace(_standings(objective, top), change=(0.0,) * COUNT)
    return CalibrationHealth(
        source=source,
        camera_id=frames[0].camera_id,
        lidar_id=frames[0].lidar_id,
        verdict=Verdict.UNDETERMINED,
        items=tuple(Item.unknown(name, reason) for name in PARTS),
        frames=len(frames),
        views=int(views.max()) + 1,
        **asdict(reported),
    )
