"""Options of the verbs that take detections, and what a path with detections is."""

from typing import TYPE_CHECKING, Any

from sceneloom.cli import options
from sceneloom.cli.options import option

if TYPE_CHECKING:
    from sceneloom.pipeline.detection_lists import DetectionInput

_BOXES = (
    option(
        "--boxes3d=FILE…",
        "Boxes detected in sweeps: JSON lines of table 7, nuScenes' JSON, KITTI's text; may be repeated.",
        options.source(),
    ),
    option(
        "--boxes2d=FILE…",
        "Boxes detected in images: JSON lines of table 8, KITTI's text; may be repeated.",
        options.source(),
    ),
)
_SENSORS = (
    option("--lidar=ID", "Lidar that --boxes3d refers to; required if there are several."),
    option(
        "--camera=ID… cameras", "Camera that --boxes2d refers to, one for each file; required if there are several."
    ),
)
_KITTI = (
    option("--det2d=NAME", "Which of several folders det2d_* to read."),
    option("--det3d=NAME", "Which of several folders det3d_* to read."),
    option("--sequence=NAME… sequences", "Only this sequence; may be repeated."),
)  # choices in a folder laid out like KITTI's tracking benchmark
_DETECTORS = option(
    "--detectors=NAME",
    "Error model of the detectors: a name, or a TOML file. [default: in KITTI's folders those of KITTI, else "
    "simulated ones]",
)
NAMES = ("boxes3d", "boxes2d", "lidar", "cameras", "det2d", "det3d", "sequences", "detectors")
"""The names of the parameters; the ego trajectory is an option of other verbs, too."""


def fused(command: Any) -> Any:
    """On every verb that fuses detections."""
    return _added(command, *_BOXES, *_SENSORS, *_KITTI, _DETECTORS)


def compared(command: Any) -> Any:
    """On a verb that looks at boxes alone."""
    return _added(command, *_BOXES, *_KITTI)


def _added(command: Any, *added: Any) -> Any:
    """Add options to a verb that reads drives: `--sequence` may then be repeated."""
    parameters = getattr(command, "__click_params__", [])
    parameters[:] = [parameter for parameter in parameters if parameter.name != "sequence"]
    return options.stacked(*added)(command)


def detection_input(given: dict[str, Any]) -> "DetectionInput":
    """What of a path is fused or tracked; taken out of `given`."""
    from sceneloom.pipeline.detection_lists import DetectionFiles, DetectionInput

    files = options.take(DetectionFiles, given, boxes_3d=given.pop("boxes3d"), boxes_2d=given.pop("boxes2d"))
    return DetectionInput(
        files=files, detector_2d=given.pop("det2d"), detector_3d=given.pop("det3d"), sequences=given.pop("sequences")
    )
