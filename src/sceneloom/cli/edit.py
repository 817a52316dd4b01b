"""`sceneloom edit`: a drive in, the same drive with one thing changed out."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from msgspec import structs

from sceneloom.cli import options
from sceneloom.cli.help import Verb, Verbs
from sceneloom.cli.options import option
from sceneloom.cli.printing import Printer, print_json, print_table, several, wrote
from sceneloom.cli.running import rewriting_verb
from sceneloom.lazy import imported

if TYPE_CHECKING:  # the pipeline takes seconds to import, and `--help` needs none of it
    from sceneloom.editing.thin import OnPoints
    from sceneloom.pipeline.deskewing import DeskewReport
    from sceneloom.pipeline.editing import EditReport
    from sceneloom.scene.ego import EgoMotion
    from sceneloom.scene.scene import Scene


@click.group(cls=Verbs)
def edit() -> None:
    """Change one thing of a drive, and write the drive anew."""


@dataclass(frozen=True, slots=True)
class _Edit:
    """A verb that makes one scene of another."""

    function: str
    help: str
    options: tuple[Callable[[Any], Any], ...]
    counts_points: bool = False
    joins: bool = False


_IDS = ("sensors", "without", "cameras", "lidars")  # options whose values are ids of sensors


def _box(_context: click.Context, _option: click.Parameter, text: str | None) -> tuple[float, ...] | None:
    if text is None:
        return None
    try:
        numbers = tuple(map(float, text.split(",")))
    except ValueError:
        numbers = ()
    if len(numbers) != 6:
        raise click.BadParameter(f"{text!r}; expected six numbers xmin,ymin,zmin,xmax,ymax,zmax")
    return numbers


def _size(_context: click.Context, _option: click.Parameter, text: str | None) -> tuple[int, int] | None:
    match = None if text is None else re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})", text)
    if text is not None and match is None:
        raise click.BadParameter(f"{text!r}; expected width x height in pixels, such as 1280x720")
    return None if match is None else (int(match[1]), int(match[2]))


def _applied(scene: "Scene", *, only: Sequence[str] = (), **given: Any) -> "Scene":
    from sceneloom.editing.apply import apply_corrections

    ids = [annotation.id for annotation in scene.annotations]
    return apply_corrections(scene, corrections=[options.known(text, ids) for text in only] or None, **given)


def _undistorted(scene: "Scene", *, keep: str, size: tuple[int, int] | None = None, **given: Any) -> "Scene":
    from sceneloom.editing.cameras import undistort_scene

    width, height = size or (None, None)
    return undistort_scene(scene, keep=_KEEP[keep], width=width, height=height, **given)


_PATHS = ("cuboids", "keypoints", "poses")
_KEEP = {"valid": 0.0, "all": 1.0}
_TRAJECTORY = options.trajectory()
_CAMERAS = option("--camera=ID… cameras", "The only cameras to change. [default: all]")
_ANNOTATIONS_IN = option(
    "--annotations-in=world|ego", "The frame of the annotations in a scene that does not state it. [default: world]"
)

_EDITS: Mapping[str, _Edit] = {
    "crop": _Edit(
        "sceneloom.editing.crop:crop_scene",
        "Keep a part of a scene: in time, in space, of some sensors or labels.",
        (
            options.part,
            option("--box=BOX", "Keep what is in xmin,ymin,zmin,xmax,ymax,zmax [m].", callback=_box),
            option("--frame=world|ego|sensor", "The frame along whose axes the box lies.", default="world"),
            option(
                "--range=M reach",
                "Keep what is within this distance of the sensor; of the ego with `--frame ego`.",
                float,
            ),
            option("--sensor=ID… sensors", "The only sensors to keep. [default: all]"),
            option("--without=ID…", "Sensors to leave out."),
            option("--label=LABEL… labels", "The only labels to keep. [default: all]"),
            _TRAJECTORY,
        ),
        counts_points=True,
    ),
    "merge": _Edit(
        "sceneloom.editing.merge:merge_scenes",
        "Make one scene of several scenes of one drive on one clock.",
        (
            option("--rename", "Give new ids to sensors and annotations whose ids are taken."),
            option("--join", "Treat sensors and annotations of equal ids as consecutive parts of one."),
            option("--force", "Also merge scenes of different drives by city, time, fixes or ego poses."),
        ),
        joins=True,
    ),
    "thin": _Edit(
        "sceneloom.editing.thin:thin_scene",
        "Keep fewer points, or fewer frames; labelled points follow.",
        (
            option("--voxel=M", "Keep one point of each cube of this side.", float),
            option(
                "--keep=nearest|first",
                "Which point of a cube to keep: the one nearest to their mean, or the first.",
                default="nearest",
            ),
            option("--share=S", "Keep this share of the points, 0 to 1, evenly spread.", float),
            option("--points=N", "Keep at most N points of each frame, evenly spread.", int),
            option("--every=N", "Keep every Nth frame of each lidar, radar and camera.", int, default=1),
            option("--sensor=ID… sensors", "The only sensors to thin. [default: all]"),
        ),
        counts_points=True,
    ),
    "to-world": _Edit(
        "sceneloom.editing.move_world:to_world",
        "Bring points, poses and annotations into the world, each frame at its own time.",
        (_TRAJECTORY, _ANNOTATIONS_IN),
    ),
    "to-ego": _Edit(
        "sceneloom.editing.move_world:to_ego",
        "Bring points, poses and annotations into the ego frame, each frame at its own time.",
        (_TRAJECTORY, _ANNOTATIONS_IN),
    ),
    "to-sensor": _Edit(
        "sceneloom.editing.move_world:to_sensor",
        "Bring the points of lidars and radars into the frames of their sensors.",
        (_TRAJECTORY,),
    ),
    "count": _Edit(
        "sceneloom.cli.edit:_counted",
        "Count the points in each cuboid: an attribute `points` per lidar, and labelled points on request.",
        (
            _TRAJECTORY,
            option("--lidar=ID… lidars", "The only lidars whose points to count. [default: all]"),
            option(
                "--at=frame|points",
                "Interpolate cuboids at the time of the frame (deskewed sweeps), or of each point (as measured).",
                default="frame",
            ),
            option("--margin=M", "Count points so far outside, too.", float, default=0.0),
            option("--activations", "Also report when each lidar has points of each cuboid."),
            option("--labeled-points", "Add an annotation of labelled points for each cuboid."),
        ),
    ),
    "project": _Edit(
        "sceneloom.cli.edit:_projected",
        "Project the cuboids into the cameras: boxes in each image, shares truncated and occluded.",
        (
            _TRAJECTORY,
            option("--camera=ID… cameras", "The only cameras to project into. [default: all]"),
            option(
                "--min-pixels=N",
                "Ignore what is narrower or lower than this in an image.",
                options.not_negative,
                default=1.0,
            ),
            option(
                "--see-through=LABEL…", "Labels that fill little of their cuboids, such as trees, and occlude nothing."
            ),
            option("--lidar=ID", "Also use the points of this lidar for occlusion."),
            option("--activations", "Also report when each camera sees each cuboid."),
        ),
    ),
    "simplify": _Edit(
        "sceneloom.cli.edit:_simplified",
        "Keep only those timestamps of paths that the others do not give within the tolerances.",
        (
            option(
                "--tolerance-m=M",
                "Error of interpolated positions and sizes at most.",
                options.not_negative,
                default=0.01,
            ),
            option(
                "--tolerance-deg=DEG", "Error of interpolated rotations at most.", options.not_negative, default=0.1
            ),
            option("--only…", "The only paths to simplify. [default: all]", _PATHS),
        ),
    ),
    "apply": _Edit(
        "sceneloom.cli.edit:_applied",
        "Apply localization adjustments and camera calibrations, and remove them.",
        (
            option("--only=ID…", "The only annotations to apply. [default: all adjustments and calibrations]"),
            _ANNOTATIONS_IN,
        ),
    ),
    "anonymise": _Edit(
        "sceneloom.editing.anonymise:anonymised_scene",
        "Remove where a drive was, by whom, and on request when.",
        (
            option(
                "--fixes=drop|shift", "Satellite fixes: left out, or moved to latitude 0, longitude 0.", default="drop"
            ),
            option(
                "--dates=keep|shift", "Time of day: kept, or counted from the drive's first timestamp.", default="keep"
            ),
        ),
    ),
    "undistort": _Edit(
        "sceneloom.cli.edit:_undistorted",
        "Resample images for pinhole camera models; what is drawn into them follows.",
        (
            _CAMERAS,
            option(
                "--keep",
                "Show only what fills the image, or all that the old one shows, with black where it shows nothing.",
                list(_KEEP),
                default="valid",
            ),
            option("--size=WxH", "Size of the new images. [default: as before]", callback=_size),
        ),
    ),
    "camera-model": _Edit(
        "sceneloom.editing.cameras:convert_camera_models",
        "Replace the camera models by the closest fits of another model; images stay as they are.",
        (
            option("--model=NAME", "Projection model of the new camera models.", required=True),
            _CAMERAS,
            option(
                "--limit=PX limit_px",
                "Refuse a camera model that deviates more than so many pixels anywhere in the image.",
                options.not_negative,
                default=1.0,
            ),
            option(
                "--share=S",
                "Refuse a camera model that covers less than this share of the image, 0 to 1.",
                options.not_negative,
                default=0.99,
            ),
        ),
    ),
}  # the verbs that are one function of the library each


def _command(name: str, row: _Edit) -> click.Command:
    def run(output: Path, printer: Printer, reading: dict[str, Any], **given: Any) -> None:
        from sceneloom.pipeline.editing import edit_files

        paths = given.pop("paths") if row.joins else [given.pop("path")]
        writing = {name: given.pop(name) for name in ("overwrite", "profile", "time_unit")}
        details: dict[str, Any] = {}

        def change(scenes: "Sequence[Scene]", on_points: "OnPoints") -> "Scene":
            chosen = {key: value for key, value in given.items() if value is not None and value != ()}
            chosen |= {key: options.known_ids(scenes[0], chosen[key]) for key in _IDS if key in chosen}
            chosen |= {"on_points": on_points} if row.counts_points else {}
            changed: Any = imported(row.function)(scenes if row.joins else scenes[0], **chosen)
            if isinstance(changed, tuple):
                changed, found = changed
                details.update(found)
            scene: Scene = changed
            return scene

        with printer.progress(f"edit {name}") as progress:
            report = edit_files(
                name, paths, output, change, reading=reading, progress=progress, **options.stated(**writing)
            )
        if printer.as_json:
            print_json({**structs.asdict(report), **details})
            return
        for title, value in details.items():
            if isinstance(value, int | str):
                click.echo(f"{title.replace('_', ' ')}: {value}")
        _print_edit(report, printer)

    run.__name__ = name
    argument = (
        click.argument("paths", nargs=-1, required=True, type=options.location)
        if row.joins
        else click.argument("path", type=options.location)
    )
    decorated = options.stacked(argument, _OUTPUT, *row.options)(rewriting_verb(run))
    return click.command(name, cls=Verb, help=row.help, examples=_EXAMPLES[name])(decorated)


_OUTPUT = options.output("The file or folder to write; its suffix chooses the format.")

_EXAMPLES = {
    "anonymise": ("drive.sfs -o shared.sfs", "drive.sfs --fixes shift --dates shift -o shared.sfs"),
    "apply": ("drive.sfs -o corrected.sfs", "drive.sfs --only calibration-1 -o corrected.sfs"),
    "blur": ("drive.sfs --boxes faces.csv -o shared.sfs", "drive.sfs --label Pedestrian --fill black -o shared.sfs"),
    "camera-model": (
        "drive.sfs --model pinhole -o pinhole.sfs",
        "drive.sfs --model brown_conrady --limit 0.5 -o brown.sfs",
    ),
    "count": ("labels.sfs -o counted.sfs", "labels.sfs --lidar top --labeled-points -o counted.sfs"),
    "crop": ("drive.sfs --start 10 --stop 20 -o part.sfs", "drive.sfs --range 50 --sensor lidar -o near.sfs"),
    "deskew": ("drive/ -o deskewed.sfs", "drive/ --trajectory gnss --at end -o deskewed.sfs"),
    "merge": ("lidar.sfs cameras.sfs -o drive.sfs", "part1.sfs part2.sfs --join -o drive.sfs"),
    "project": ("labels.sfs -o projected.sfs", "labels.sfs --camera front --min-pixels 10 -o projected.sfs"),
    "simplify": ("labels.sfs -o simpler.sfs", "labels.sfs --tolerance-m 0.02 --only cuboids -o simpler.sfs"),
    "thin": ("drive.sfs --voxel 0.1 -o thin.sfs", "drive.sfs --every 5 -o thin.sfs"),
    "to-ego": ("drive.sfs -o ego.sfs", "drive.sfs --trajectory gnss -o ego.sfs"),
    "to-sensor": ("drive.sfs -o sensor.sfs", "drive.sfs --trajectory gnss -o sensor.sfs"),
    "to-world": ("drive.sfs -o world.sfs", "drive.sfs --trajectory lidar -o world.sfs"),
    "undistort": ("drive.sfs -o undistorted.sfs", "drive.sfs --camera front --size 1280x720 -o undistorted.sfs"),
}


def _print_edit(report: "EditReport", printer: Printer) -> None:
    before, after = report.before, report.after
    click.echo(f"{report.edit}: done in {report.seconds:.1f} s")
    for noun in ("sensor", "frame", "point", "annotation"):
        was, is_now = getattr(before, f"{noun}s"), getattr(after, f"{noun}s")
        those = " of the frames that stay" if noun == "point" and before.frames != after.frames else ""
        click.echo(several(was, noun) if was == is_now else f"{several(was, noun)}{those} -> {is_now}")
    wrote(report.output)
    printer.remarks(report)


# what some of them do besides calling a function of the library


def _chosen_trajectory(scene: "Scene", given: dict[str, Any]) -> "EgoMotion | str | None":
    """The ego trajectory that was asked for; the name itself where the scene needs none, which is refused later."""
    from sceneloom.motion.ego_trajectory import find_ego_motion
    from sceneloom.scene.ego import needs_ego

    trajectory: str | None = given.pop("trajectory", None)
    heading = given.pop("heading", None)
    if (trajectory is None and heading is None) or not needs_ego(scene):
        return trajectory
    return find_ego_motion(scene, name=trajectory, heading=heading)


def _counted(
    scene: "Scene", *, at: str, activations: bool, labeled_points: bool, **given: Any
) -> "tuple[Scene, dict[str, Any]]":
    import numpy as np

    from sceneloom.colouring.cuboid_projection import count_points, with_activations, with_counts, with_labeled_points

    scene = scene.corrected()
    trajectory = _chosen_trajectory(scene, given)
    counts = count_points(
        scene, moment=at, trajectory=trajectory, listed=labeled_points, activations=not activations, **given
    )
    totals = np.sum([lidar.counts.sum(axis=0) for lidar in counts.lidars], axis=0)
    points = dict(zip(map(str, counts.annotation_ids), map(int, totals), strict=True)) if counts.lidars else {}
    details = {
        "cuboids": len(counts.annotation_ids),
        "points_in_cuboids": sum(points.values()),
        "cuboids_without_points": sum(number == 0 for number in points.values()),
        "frames_without_pose": counts.unplaced,
        "points_by_cuboid": points,
    }
    counted = with_counts(scene, counts)
    counted = with_activations(counted, counts) if activations else counted
    return with_labeled_points(counted, counts) if labeled_points else counted, details


def _projected(scene: "Scene", *, lidar: str | None = None, **given: Any) -> "tuple[Scene, dict[str, Any]]":
    from sceneloom.colouring.cuboid_projection import project_cuboids
    from sceneloom.scene.annotations import CuboidAnnotation

    trajectory = _chosen_trajectory(scene, given)
    projected = project_cuboids(scene, trajectory=trajectory, lidar=options.known_id(scene, lidar), **given)
    cuboids = [each for each in projected.annotations if isinstance(each, CuboidAnnotation)]
    return projected, {
        "cuboids": len(cuboids),
        "cuboids_seen": sum(bool(each.projections) for each in cuboids),
        "projections": sum(len(each.projections) for each in cuboids),
    }


def _simplified(
    scene: "Scene", *, tolerance_m: float, tolerance_deg: float, only: Sequence[str] = _PATHS
) -> "tuple[Scene, dict[str, Any]]":
    from sceneloom.editing.simplify import simplify_scene

    found = simplify_scene(
        scene, tolerance_m=tolerance_m, tolerance_deg=tolerance_deg, **{name: name in only for name in _PATHS}
    )
    new = found.warnings[len(scene.warnings) :]
    return found, {"timestamps_left_out": sum(warning.count for warning in new)}


for _name, _row in _EDITS.items():
    edit.add_command(_command(_name, _row))


# jobs of their own


@edit.command(examples=_EXAMPLES["deskew"])
@click.argument("path", type=options.location)
@_OUTPUT
@options.trajectory("`imu`: only the rotation measured by the IMU")
@option("--at=start|middle|end", "The moment of each sweep to move its points to.", default="middle")
@option("--lidar=ID", "The only lidar to deskew. [default: all]")
@options.part
@rewriting_verb
def deskew(
    path: Path | str, output: Path, lidar: str | None, printer: Printer, reading: dict[str, Any], **given: Any
) -> None:
    """Undo the motion during each lidar sweep: points stay in their sensor, as if measured all at one time."""
    from sceneloom.formats.base.registry import open_scene
    from sceneloom.pipeline.deskewing import deskew as deskew_scene
    from sceneloom.pipeline.warm_up import compile_for

    own = {"lenient": "lenient" in reading, **options.scene_options(given), **given}
    with open_scene(path, **reading) as scene, printer.progress("deskewing") as progress:
        compile_for("deskew", scene)
        report = deskew_scene(scene, output, lidar=options.known_id(scene, lidar), progress=progress, **own)
    printer.show(report, _print_deskewing)


def _print_deskewing(report: "DeskewReport", printer: Printer) -> None:
    trajectory = "the lidars' own poses" if report.trajectory is None else f"trajectory {report.trajectory}"
    click.echo(
        f"deskewed {report.deskewed} of {several(report.sweeps, 'sweep')} by {trajectory} to the {report.at} of each, "
        f"in {report.seconds:.1f} s"
    )
    click.echo(
        f"{several(report.points, 'point')} moved by {report.mean_shift:.3f} m on average, "
        f"by {report.max_shift:.3f} m at most"
    )
    if report.extrapolated:
        sweeps = several(report.extrapolated, "sweep")
        click.echo(f"{sweeps} used poses beyond the trajectory's ends, by at most one sweep period")
    for reason, count in report.left.items():
        click.echo(f"{several(count, 'sweep')} left as measured: {reason}")
    if report.skipped:
        click.echo(f"{several(len(report.skipped), 'unreadable sweep')} skipped")
    wrote(report.output)
    printer.remarks(report)


@edit.command(examples=_EXAMPLES["blur"])
@click.argument("path", type=options.location)
@_OUTPUT
@option(
    "--boxes=FILE box_file",
    "CSV or JSON of what to redact: camera, number or time of the image, x1, y1, x2, y2, track.",
    options.source(),
)
@option("--label=LABEL… labels", "Redact the drive's own boxes and outlines in images with this label.")
@option(
    "--fill=blur|pixelate|black",
    "What replaces the pixels: at most 4 x 4 mean colours, smooth or in squares, or black.",
    default="blur",
)
@option(
    "--margin=S", "Share of its width and height by which a box grows on each side.", options.not_negative, default=0.1
)
@option(
    "--hold=S",
    "Redact tracks and annotations S seconds before their first and after their last image.",
    options.not_negative,
    default=0.0,
)
@option("--drop-colours", "Remove the colours of points that cameras gave them.")
@rewriting_verb
def blur(
    path: Path | str,
    output: Path,
    box_file: Path | None,
    labels: tuple[str, ...],
    printer: Printer,
    reading: dict[str, Any],
    **given: Any,
) -> None:
    """Redact faces, plates and other regions in videos and images for good."""
    from sceneloom.pipeline.redacting import blur_files, read_image_boxes

    boxes = () if box_file is None else read_image_boxes(box_file)
    names = tuple(name for label in labels for name in label.split(",") if name)
    own = {"boxes": boxes, "labels": names, "reading": reading, **options.scene_options(given), **given}
    with printer.progress("edit blur") as progress:
        report = blur_files(path, output, progress=progress, **own)
    if printer.as_json:
        chosen = {name: given[name] for name in ("fill", "margin")}
        print_json({**structs.asdict(report.edit), **chosen, "cameras": report.cameras})
        return
    _print_edit(report.edit, printer)
    rows = [("camera", "boxes", "regions redacted", "in images", "outside", "video")]
    for one in report.cameras:
        video = "" if one.encoded is None else f"{one.encoded} encoded again"
        outside = str(one.outside + one.without_image)
        images = f"{one.images} of {one.of_images}"
        rows.append((str(one.camera), str(one.boxes), str(one.hidden), images, outside, video))
    print_table(rows)
