"""A long drive fused in parts: the sweeps of each go into a file of their own, of which one last task makes the scene.

Every part knows the whole drive but its sweeps: the ego's way, the periods of the sensors, the numbers of the frames.
So a sweep is fused as in the whole, by the pictures around it, which are read a little beyond the ends of the part.
"""

import time
from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import msgspec

from sceneloom.arrays import AnyArray, Int64Array
from sceneloom.colouring.results import FusedFrame
from sceneloom.errors import DataError, OptionError
from sceneloom.fusion import FusionConfiguration
from sceneloom.motion.odometry import OdometryRun
from sceneloom.pipeline.fusing.job import fusion_system, write_fused
from sceneloom.pipeline.fusing.outputs import FusionOutputs, checked_outputs
from sceneloom.pipeline.fusing.report import FrameCounts, FusionReport
from sceneloom.pipeline.needed_lidar import check_has_lidar
from sceneloom.pipeline.parts.records import read_records, writing_records
from sceneloom.pipeline.play import Skips, play, telling
from sceneloom.pipeline.woven.scene import weave
from sceneloom.scene import LidarPoints, Scene
from sceneloom.scene.point_times import TimesFound
from sceneloom.scene.span import scene_period_ns
from sceneloom.stages import timed

_LEAD_NS, _LEAD_PERIODS = 2_000_000_000, 4
"""So long, and so many sweeps, before and after a part frames are read: pictures of its first and last sweeps, and what
the times of points were before."""

_COLUMNS = ("positions", "intensities", "colors", "timestamps_ns", "rings", "camera_index")
_FRAME = ("lidar_id", "index", "timestamp_ns", "reference_ns", "extrapolated", "unfused", "standing")


def reference_times(scene: Scene) -> Int64Array:
    """The times (N,) int64 [ns] of the lidar with the most sweeps, between which a drive is cut.

    Raises:
        DataError: there is no lidar.
    """
    check_has_lidar(scene, "fusing needs")
    return max((lidar.frames.timestamps_ns for lidar in scene.lidars), key=len)


def fuse_part(
    scene: Scene,
    target: Path,
    *,
    span_ns: tuple[int, int],
    odometry: OdometryRun | None = None,
    configuration: FusionConfiguration | None = None,
    lenient: bool = False,
    **chosen: Any,
) -> int:
    """Fuse the sweeps of a part of a drive into a file for `join_fused`; gives how many these are.

    Args:
        scene: the whole drive.
        target: the file to write.
        span_ns: [start, stop) of its sweeps [ns].
        odometry: the way by the sweeps of all parts, where it is needed.
        configuration, lenient: as of `fuse`.
        chosen: `trajectory`, `heading`, `start`, `stop` as of `fuse`.

    Raises:
        SceneloomError: as of `fuse`.
    """
    woven = weave(scene, lenient=lenient, odometry=odometry, **chosen)
    skips = Skips() if lenient else None
    system = fusion_system(woven, configuration, skips)
    lead_ns = max(_LEAD_NS, _LEAD_PERIODS * scene_period_ns(woven.scene))
    stamps = {lidar.id: lidar.frames.timestamps_ns for lidar in woven.scene.lidars}
    count = 0
    with telling(skips), writing_records(target) as records:
        around_ns = (span_ns[0] - lead_ns, span_ns[1] + lead_ns)
        for frame in play(woven.scene, system, skips=skips, within_ns=around_ns):
            if span_ns[0] <= stamps[frame.lidar_id][frame.index] < span_ns[1]:
                records.add(*_record(frame))
                count += 1
        records.add({"skipped": [] if skips is None else list(skips.reasons), "count": count}, {})
    return count


def join_fused(
    scene: Scene,
    files: Sequence[Path],
    *,
    outputs: FusionOutputs,
    odometry: OdometryRun | None = None,
    lenient: bool = False,
    **chosen: Any,
) -> FusionReport:
    """Write the scene of a drive whose sweeps were fused in parts; one sweep is in memory at a time.

    Args:
        scene: the whole drive.
        files: as `fuse_part` wrote them, in the order of time.
        outputs: the scene to write.
        odometry, lenient, chosen: as of `fuse_part`.

    Raises:
        OptionError: something is asked for that is made of whole pictures.
        SceneloomError: as of `fuse`.
    """
    begun = time.perf_counter()
    check_outputs_of_parts(outputs)
    with timed() as stages:
        woven = weave(scene, lenient=lenient, odometry=odometry, **chosen)
        skips = Skips() if lenient else None
        frames = _joined(files, skips)
        report = write_fused(woven, checked_outputs(outputs, None), frames, skips, begun=begun)
    return msgspec.structs.replace(report, stages=dict(stages))


def check_outputs_of_parts(outputs: FusionOutputs) -> None:
    """Refuse what the task that joins the parts could not write.

    Raises:
        OptionError: something is asked for that is made of whole pictures.
    """
    if outputs.depth is not None or outputs.pictures is not None:
        raise OptionError(
            "--depth and --pictures are not written of drives in parts; leave them out, or --parts"
        )


def _record(frame: FusedFrame) -> tuple[dict[str, Any], dict[str, AnyArray]]:
    """A sweep without its views, of which only their counts are needed later."""
    columns = {name: getattr(frame.points, name) for name in _COLUMNS}
    arrays = {name: array for name, array in columns.items() if array is not None}
    values = {
        **{name: getattr(frame, name) for name in _FRAME},
        "extras": dict(frame.extras),
        "counts": msgspec.to_builtins(FrameCounts.of(frame)),
        "times": msgspec.to_builtins(frame.times, enc_hook=str),
    }
    return values, {**arrays, **{f"extras.{name}": array for name, array in frame.points.extras.items()}}


def _joined(files: Iterable[Path], skips: Skips | None) -> Iterator[tuple[FusedFrame, FrameCounts]]:
    for file in files:
        whole = False
        for values, arrays in read_records(file):
            if "skipped" in values:
                whole = True
                if skips is not None:
                    skips.reasons |= dict.fromkeys(values["skipped"])
            else:
                yield _frame(values, arrays)
        if not whole:
            raise DataError(file, "", "ends too early; expected all sweeps of a part of a drive")


def _frame(values: dict[str, Any], arrays: dict[str, AnyArray]) -> tuple[FusedFrame, FrameCounts]:
    known: dict[str, Any] = {name: arrays[name] for name in _COLUMNS if name in arrays}
    further = {name.removeprefix("extras."): array for name, array in arrays.items() if name not in known}
    points = LidarPoints(**known, extras=further)
    times = msgspec.convert(values["times"], TimesFound, dec_hook=lambda _, told: Fraction(told))
    frame = FusedFrame(
        points=points, times=times, extras=values["extras"], **{name: values[name] for name in _FRAME}
    )
    return frame, msgspec.convert(values["counts"], FrameCounts)
