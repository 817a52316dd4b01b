"""The main job: one scene in, one fused scene out."""

import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.colouring.results import FusedFrame
from sceneloom.errors import DataError, OptionError, PoseError
from sceneloom.formats.loss import LossReport
from sceneloom.formats.output import check_output, filling
from sceneloom.formats.sfs import SceneWriter
from sceneloom.fusion import FusionConfiguration
from sceneloom.motion.ego_motion import Progress, placeable_lidars
from sceneloom.pictures.drive_cloud import MOST_SWEEPS, DriveCloud
from sceneloom.pipeline.play import Skips, build_system, play
from sceneloom.pipeline.report import CameraTally, FusionReport, FusionTally, told_once
from sceneloom.pipeline.sinks import DepthSink, PictureSink, SceneSink, Sink, lidar_folders, names_of
from sceneloom.pipeline.woven import Woven, output_scene, weave
from sceneloom.scene import CameraSensor, LazyFrames, Picture, Scene
from sceneloom.scene.span import scene_period_ns, time_span

PICTURES_PER_DRIVE = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class FusionOutputs:
    """Where a fusion writes what; None: not at all.

    Attributes:
        scene: the `.sfs` file.
        depth: folder of depth images, one per sweep and picture.
        depth_form: "png" (16 bit, metres times 256) or "npz" (float32 metres).
        pictures: folder of pictures for people.
        pictures_every: draw every Nth sweep; None: eight spread over the drive.
        profile: "sfs", or "scale" for a file that Scale's own library accepts.
        time_unit: "microseconds" or "nanoseconds", of the scene file.
        overwrite: whether outputs that exist may be replaced.
    """

    scene: Path | None = None
    depth: Path | None = None
    depth_form: str = "png"
    pictures: Path | None = None
    pictures_every: int | None = None
    profile: str = "sfs"
    time_unit: str = "microseconds"
    overwrite: bool = False


def iter_fused(
    scene: Scene,
    *,
    trajectory: str | None = None,
    heading: str | None = None,
    configuration: FusionConfiguration | None = None,
) -> Iterator[FusedFrame]:
    """Fuse a scene sweep by sweep without writing anything.

    Args:
        trajectory: name of the ego's way; "identity" for an ego that stands still; "lidar" to find it from the sweeps;
            None for the scene's default, which is found from the sweeps where the scene has none.
        heading: "motion" to derive orientations where the trajectory has positions only.
        configuration: settings of the fusion system.

    Yields:
        One result per sweep: world points relative to the ego's first position, colours, views.

    Raises:
        PoseError: the sensors' motion is not known.
        DataError: a sweep or a picture cannot be read.
    """
    woven = weave(scene, trajectory=trajectory, heading=heading)
    yield from play(woven.scene, build_system(woven.scene, woven.ego, configuration or FusionConfiguration()))


def fuse(
    scene: Scene,
    output: str | Path | None = None,
    *,
    trajectory: str | None = None,
    heading: str | None = None,
    start: float | None = None,
    stop: float | None = None,
    outputs: FusionOutputs | None = None,
    configuration: FusionConfiguration | None = None,
    lenient: bool = False,
    progress: Progress | None = None,
) -> FusionReport:
    """Fuse lidar and cameras of a scene and write the fused scene, depth images and pictures.

    Args:
        output: the `.sfs` file to write; the same as `outputs.scene`.
        trajectory: name of the ego's way; "identity" for an ego that stands still; "lidar" to find it from the sweeps;
            None for the scene's default, which is found from the sweeps where the scene has none.
        heading: "motion" to derive orientations where the trajectory has positions only.
        start: seconds after the scene's first time stamp, None for the beginning.
        stop: seconds after it, exclusive, None for the end.
        outputs: where to write what, and how.
        configuration: settings of the fusion system.
        lenient: count sweeps and pictures that cannot be read, and go on.
        progress: told after each sweep; each counts twice where the ego's way is found from the sweeps first.

    Returns:
        What was done, in numbers, with all losses and notices.

    Raises:
        PoseError: the sensors' motion is not known, or at the time of no sweep.
        DataError: there is no lidar, or a sweep or a picture cannot be read.
        OutputError: an output exists, or cannot be written.
        OptionError: a value is not one that can be followed.
    """
    begun = time.perf_counter()
    if not scene.lidars:
        raise DataError(scene.source, "", "no lidar in it; fusing needs one")
    wanted = _checked(outputs or FusionOutputs(), output)
    steps = _Steps(progress)
    woven = weave(
        scene,
        trajectory=trajectory,
        heading=heading,
        start=start,
        stop=stop,
        lenient=lenient,
        progress=steps.finding,
    )
    skips = Skips() if lenient else None
    system = build_system(woven.scene, woven.ego, configuration or FusionConfiguration())
    if skips is not None:
        system.on_unreadable = skips.add
    tally = _tally(woven)
    total = sum(len(lidar.frames) for lidar in woven.scene.lidars)
    with ExitStack() as stack:
        sinks = _open_sinks(woven, wanted, stack, skips)
        for done, frame in enumerate(play(woven.scene, system, skips=skips), start=1):
            tally.add(frame)
            for sink in sinks.all:
                sink.add(frame)
            steps.fusing(done, total)
        _refuse_nothing_fused(scene, tally)
        losses = sinks.finish()
    return FusionReport(
        source=scene.source,
        output=None if wanted.scene is None else str(wanted.scene),
        trajectory=None if woven.ego is None else woven.ego.name,
        frames=tally.frames,
        fused=tally.fused,
        extrapolated=tally.extrapolated,
        unfused=tally.unfused,
        skipped=() if skips is None else tuple(skips.reasons),
        points=tally.points,
        coloured_percent=tally.coloured_percent,
        cameras=tuple(camera.report(camera_id) for camera_id, camera in tally.cameras.items()),
        files=sinks.files,
        depth_beyond_range=0 if sinks.depth is None else sinks.depth.beyond_range,
        seconds=time.perf_counter() - begun,
        losses=losses,
        notices=told_once(woven.scene.notices, tally.notices()),
    )


def _tally(woven: Woven) -> FusionTally:
    stands = woven.ego is not None and woven.ego.path.endless
    carried = [] if stands else placeable_lidars(woven.scene)
    return FusionTally(
        {camera.id: CameraTally(len(camera.pictures)) for camera in woven.scene.cameras},
        frozenset(lidar.id for lidar in carried),
    )


def _refuse_nothing_fused(scene: Scene, tally: FusionTally) -> None:
    if tally.unfused and not tally.fused:
        reasons = ", ".join(f"{reason} ({count} times)" for reason, count in tally.unfused.items())
        raise PoseError(
            f"{scene.source}: none of {tally.frames} sweeps could be fused: {reasons}; expected a trajectory on the "
            "clock of the sweeps; `sceneloom info` tells both spans, and `--trajectory lidar` needs none"
        )


def _checked(outputs: FusionOutputs, output: str | Path | None) -> FusionOutputs:
    wanted = outputs if output is None else replace(outputs, scene=Path(output))
    if wanted.depth_form not in {"png", "npz"}:
        raise OptionError(f"depth_form {wanted.depth_form!r}; expected 'png' or 'npz'")
    if wanted.pictures_every is not None and wanted.pictures_every < 1:
        raise OptionError(f"pictures_every {wanted.pictures_every}; expected 1 or more")
    if wanted.scene is not None and wanted.scene.suffix.lower() != ".sfs":
        raise OptionError(f"{wanted.scene}: fusing writes scene files; expected a name that ends in .sfs")
    folders = [folder.absolute() for folder in (wanted.depth, wanted.pictures) if folder is not None]
    if wanted.scene is not None and wanted.scene.absolute() in folders:
        raise OptionError(f"{wanted.scene}: named for a file and for a folder; expected two names")
    # the way of the ego may take long to find: an output that cannot be is told before
    for place in (wanted.scene, wanted.depth, wanted.pictures):
        if place is not None:
            check_output(place, overwrite=wanted.overwrite)
    return wanted


@dataclass(slots=True)
class _Steps:
    """Tells of two passes over the sweeps as of one: finding the ego's way, where it must be found, and fusing."""

    told: Progress | None
    found: int = 0

    def finding(self, done: int, total: int) -> None:
        self.found = total
        if self.told is not None:
            self.told(done, 2 * total)

    def fusing(self, done: int, total: int) -> None:
        if self.told is not None:
            self.told(self.found + done, self.found + total)


@dataclass(slots=True)
class _Sinks:
    scene: SceneSink | None = None
    depth: DepthSink | None = None
    pictures: PictureSink | None = None

    @property
    def all(self) -> list[Sink]:
        return [sink for sink in (self.scene, self.depth, self.pictures) if sink is not None]

    @property
    def files(self) -> dict[str, int]:
        kinds = {"depth images": self.depth, "pictures": self.pictures}
        return {kind: sink.written for kind, sink in kinds.items() if sink is not None}

    def finish(self) -> LossReport:
        if self.pictures is not None:
            self.pictures.finish()
        return LossReport() if self.scene is None else self.scene.finish()


def _open_sinks(woven: Woven, wanted: FusionOutputs, stack: ExitStack, skips: Skips | None) -> _Sinks:
    """Open every wanted output; what goes wrong later takes all of them away again."""
    sinks = _Sinks()
    if wanted.depth is not None:
        folder = stack.enter_context(filling(wanted.depth, overwrite=wanted.overwrite))
        sinks.depth = DepthSink(
            lidar_folders(folder, woven.scene),
            names_of(woven.scene.cameras),
            wanted.depth_form,
            folder / "index.jsonl",
        )
    if wanted.pictures is not None:
        folder = stack.enter_context(filling(wanted.pictures, overwrite=wanted.overwrite))
        sinks.pictures = PictureSink(
            folder,
            lidar_folders(folder, woven.scene),
            _frames_to_draw(woven.scene, wanted.pictures_every),
            DriveCloud(_spread(woven.scene, MOST_SWEEPS)),
            None if woven.ego is None else woven.ego.path,
        )
    if wanted.scene is not None:
        sinks.scene = _open_scene_sink(woven, wanted, wanted.scene, stack, skips)
    return sinks


def _open_scene_sink(
    woven: Woven, wanted: FusionOutputs, target: Path, stack: ExitStack, skips: Skips | None
) -> SceneSink:
    scene, sources = output_scene(woven, reach_ns=scene_period_ns(woven.scene))
    spans_ns = [span_ns for span_ns in map(time_span, (woven.scene, scene)) if span_ns is not None]
    writer = stack.enter_context(
        SceneWriter(
            target,
            overwrite=wanted.overwrite,
            profile=wanted.profile,
            time_unit=wanted.time_unit,
            first_ns=min((first_ns for first_ns, _ in spans_ns), default=None),
            frame_count=sum(len(lidar.frames) for lidar in woven.scene.lidars),
        )
    )
    if skips is None:
        writer.add_scene(scene)
    else:
        _add_readable(writer, scene, skips)
    writer.set_metadata(_provenance(woven))
    return SceneSink(writer, sources, wanted.time_unit)


def _add_readable(writer: SceneWriter, scene: Scene, skips: Skips) -> None:
    """Add a scene, but pass over single pictures that cannot be read; a video is taken as it is."""
    alone = [camera for camera in scene.cameras if camera.video is None]
    none: LazyFrames[Picture] = LazyFrames.of([], [])
    sensors = [
        replace(sensor, pictures=none)
        if isinstance(sensor, CameraSensor) and sensor.video is None
        else sensor
        for sensor in scene.sensors
    ]
    writer.add_scene(replace(scene, sensors=tuple(sensors)))
    for camera in alone:
        for index in range(len(camera.pictures)):
            try:
                writer.add_frame(camera.id, camera.pictures[index])
            except DataError as error:
                skips.add(error)


def _provenance(woven: Woven) -> Mapping[str, Any]:
    """How the fused scene came about, for its metadata; what an earlier fusion said there is kept below `earlier`.

    The cameras stand in the order that `camera_index` counts, since a profile may have no place for some of them.
    """
    world_from_file = _earlier_world(woven.scene)
    world_from_file[:3, 3] += world_from_file[:3, :3] @ woven.origin_world
    fusion = {
        "trajectory": None if woven.ego is None else woven.ego.name,
        "heading": None if woven.ego is None else woven.ego.heading,
        # the name of a folder may hold bytes that are no Unicode
        "source": Path(woven.scene.source).name.encode(errors="replace").decode(),
        "source_format": woven.scene.format,
        "cameras": [camera.id for camera in woven.scene.cameras],
        "earlier": _ours(woven.scene).get("fusion"),
    }
    return {"sceneloom": {"world_from_file": world_from_file.tolist(), "fusion": fusion}}


def _ours(scene: Scene) -> Mapping[str, Any]:
    ours = scene.metadata.get("sceneloom")
    return ours if isinstance(ours, Mapping) else {}


def _earlier_world(scene: Scene) -> Float64Array:
    """The (4, 4) transform that an earlier fusion took off, else the identity."""
    earlier = _ours(scene).get("world_from_file")
    try:
        matrix = np.eye(4) if earlier is None else np.array(earlier, np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        place = "metadata.sceneloom.world_from_file"
        raise DataError(scene.source, place, f"{earlier!r}; expected a 4x4 matrix of finite numbers")
    return matrix


def _frames_to_draw(scene: Scene, every: int | None) -> frozenset[int]:
    """Numbers of the sweeps to draw: every Nth, or some spread over the drive."""
    return (
        _spread(scene, PICTURES_PER_DRIVE)
        if every is None
        else frozenset(range(0, _most_sweeps(scene), every))
    )


def _spread(scene: Scene, most: int) -> frozenset[int]:
    """Numbers of at most so many sweeps, spread over the drive."""
    count = _most_sweeps(scene)
    return frozenset(np.linspace(0, count - 1, min(most, count)).astype(int).tolist())


def _most_sweeps(scene: Scene) -> int:
    return max((len(lidar.frames) for lidar in scene.lidars), default=0)
