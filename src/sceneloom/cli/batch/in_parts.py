"""Verbs over a part of a drive, and over all its parts together: done in place of the verb's own function."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from sceneloom.errors import OptionError

if TYPE_CHECKING:
    from sceneloom.formats.kitti import KittiTracking
    from sceneloom.motion.odometry import OdometryRun
    from sceneloom.pipeline.detections.detected import DetectedDrive
    from sceneloom.pipeline.found_objects import DetectionInput
    from sceneloom.scene import Scene

WHOLE: Mapping[str, str] = MappingProxyType(
    {
        "convert": "it only copies, and joining the parts would copy everything once more",
        "validate": "many of its rules look at a drive as a whole",
        "report": "its page is about a drive as a whole",
    }
)
"""Verbs that do a drive in one piece, and why."""

_FOLLOWING = frozenset({"odometry", "way"})
"""What is done first where the way is found from the sweeps."""


def check_parts(verb: str) -> None:
    """Refuse to split drives for a verb that does them in one piece.

    Raises:
        OptionError: it is one of those.
    """
    if verb in WHOLE:
        raise OptionError(f"--parts: {verb} does a drive in one piece: {WHOLE[verb]}; expected fuse or track")


def instead_of(verb: str, piece: Mapping[str, Any], target: Path) -> Callable[..., Any]:
    """What is called in place of the verb's function, with the same arguments, for a piece of a drive.

    Args:
        verb: its name.
        piece: which one, as `batch.pieces` says.
        target: the file to write.
    """
    done: Mapping[str, Callable[..., Any]] = {"fuse": _fuse, "track": _track}
    return partial(done[verb], piece, target)


def _fuse(piece: Mapping[str, Any], target: Path, scene: "Scene", **how: Any) -> Any:
    from sceneloom.batch.pieces import stage_files
    from sceneloom.pipeline.fusing.parts import check_outputs_of_parts, fuse_part, join_fused, reference_times
    from sceneloom.scene.part import cut_scene

    del how["progress"]
    outputs, configuration = how.pop("outputs"), how.pop("configuration")
    if piece["work"] == "plan":
        check_outputs_of_parts(outputs)
        part = cut_scene(scene, start=how["start"], stop=how["stop"])
        return _stages("fuse", part, reference_times(part), piece, how["trajectory"])
    if piece["work"] in _FOLLOWING:
        return _follow(piece, target, cut_scene(scene, start=how["start"], stop=how["stop"]), how["lenient"])
    way = _way(piece)
    if piece["work"] == "join":
        return join_fused(scene, stage_files(piece), outputs=outputs, odometry=way, **how)
    return fuse_part(
        scene, target, span_ns=tuple(piece["span_ns"]), odometry=way, configuration=configuration, **how
    )


def _track(
    piece: Mapping[str, Any],
    target: Path,
    path: "Path | str",
    output: Path,
    *,
    chosen: "DetectionInput",
    lenient: bool,
    reading: Mapping[str, Any],
    **how: Any,
) -> Any:
    from sceneloom.batch.pieces import stage_files
    from sceneloom.pipeline.detections.detected_scene import scene_drive
    from sceneloom.pipeline.found_objects import open_listed, open_sequences
    from sceneloom.pipeline.fusing.parts import reference_times
    from sceneloom.pipeline.tracking.parts import track_joined

    del how["progress"]
    if how["settings"].offline:
        raise OptionError("--offline smooths over a drive as a whole; leave it out, or --parts")
    folder = open_sequences(path, chosen, lenient=lenient, reading=reading)
    if folder is not None:
        return _track_sequences(piece, target, folder, output, sequences=chosen.sequences, **how)
    with open_listed(path, chosen, lenient=lenient, reading=reading) as (scene, files):
        if piece["work"] == "plan":
            return _stages("track", scene, reference_times(scene), piece, files.trajectory)
        if piece["work"] in _FOLLOWING:
            return _follow(piece, target, scene, lenient)
        drive = scene_drive(scene, files, lenient=lenient, odometry=_way(piece))
        if piece["work"] == "join":
            return track_joined(drive, scene, stage_files(piece), output, **how)
        return _track_part(piece, target, drive, how)


def _track_sequences(
    piece: Mapping[str, Any],
    target: Path,
    folder: "KittiTracking",
    output: Path,
    *,
    sequences: Sequence[str],
    **how: Any,
) -> Any:
    """As for one drive; each sequence has parts of its own, be it only one."""
    from sceneloom.batch.pieces import cut_times, stage_files
    from sceneloom.pipeline.detections.detected import kitti_drive
    from sceneloom.pipeline.tracking.parts import track_folder_joined

    if piece["work"] == "plan":
        times = {name: folder.sequence(name).timestamps_ns for name in folder.chosen(sequences)}
        pieces = [
            {"work": "track", "sequence": name, "span_ns": list(span)}
            for name, times_ns in times.items()
            for span in cut_times(times_ns, seconds=piece["seconds"], count=piece["count"])
        ]
        return [pieces] if len(pieces) > 1 else []
    if piece["work"] == "join":
        return track_folder_joined(folder, stage_files(piece), output, sequences=sequences, **how)
    return _track_part(piece, target, kitti_drive(folder.sequence(piece["sequence"])), how)


def _track_part(
    piece: Mapping[str, Any], target: Path, drive: "DetectedDrive", how: Mapping[str, Any]
) -> int:
    from sceneloom.pipeline.tracking.parts import track_part

    own = {name: how[name] for name in ("settings", "box2d") if name in how}
    return track_part(drive, target, span_ns=tuple(piece["span_ns"]), **own)


def _stages(
    work: str, scene: "Scene", times_ns: Any, piece: Mapping[str, Any], trajectory: str | None
) -> list[list[dict[str, Any]]]:
    """The pieces of a drive: its way first, where that is found from the sweeps; none where it is short."""
    from sceneloom.batch.pieces import cut_times
    from sceneloom.pipeline.parts.odometry import annotations_need_way, goes_by_sweeps

    spans = cut_times(times_ns, seconds=piece["seconds"], count=piece["count"])
    if len(spans) == 1 or annotations_need_way(scene, trajectory):
        return []
    own = [[{"work": each, "span_ns": list(span)} for span in spans] for each in ("odometry", work)]
    return [own[0], [{"work": "way"}], own[1]] if goes_by_sweeps(scene, trajectory) else own[1:]


def _follow(piece: Mapping[str, Any], target: Path, scene: "Scene", lenient: bool) -> int:
    """Find the ego's way through a part of a drive, or make one way of those of all parts."""
    from sceneloom.batch.pieces import stage_files
    from sceneloom.pipeline.parts.odometry import follow_part, join_ways

    if piece["work"] == "way":
        return join_ways(stage_files(piece, 0), target, scene.source)
    return follow_part(scene, target, span_ns=tuple(piece["span_ns"]), lenient=lenient)


def _way(piece: Mapping[str, Any]) -> "OdometryRun | None":
    """The way of all parts, where earlier stages have found it."""
    from sceneloom.batch.pieces import stage_files
    from sceneloom.pipeline.parts.odometry import read_way

    return read_way(stage_files(piece, 1)[0]) if len(piece["stages"]) > 1 else None
