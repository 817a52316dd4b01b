"""The kernels that a job needs: a first run compiles them at once, on all processors, and not one after another.

A kernel that is missing here is compiled when it is called, as any other. Within a group those that take longest come
first.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING

from sceneloom.cameras.camera import MODELS
from sceneloom.kernels.cache import compile_ahead, compiling_ahead

if TYPE_CHECKING:
    from sceneloom.scene.scene import Scene


def _of(module: str, names: str) -> tuple[str, ...]:
    return tuple(f"sceneloom.{module}:{name}" for name in names.split())


_FUSION = (
    *_of("colouring.visibility", "_search_hiding _bound_hiding _measure_extent _keep_nearest _occupy _find_holders"),
    *_of("kernels.poses", "transform_by_path"),
    *_of("colouring.blending", "paint_points"),
    *_of("kernels.projection", "_draw_rows"),
    *_of("colouring.visibility", "find_slopes _read_keys _position_grid"),
)
_ODOMETRY = (*_of("motion.odometry", "accumulate_normal_equations _describe_surfaces _insert_points move_points"),)
_READING = (*_of("kernels.images", "rgb_from_halved_chroma"), *_of("kernels.packed", "unpack"))
_DEPTH = _of("colouring.depth_completion", "triangulate fill_triangles measure_triangles hilbert_codes grade_depths")
_COLOUR = (
    *_of("colouring.exposure", "mark_outlines measure_contrasts"),
    *_of("kernels.projection", "sample_footprints"),
)
_CASTING = _of("simulate.casting", "_paint_rays _trace_rays")
_CALIBRATION = (*_of("kernels.projection", "_map_all"), *_of("calibrate.measures", "sum_edges fill_histogram"))
_DETECTIONS = (
    *_of("detections.projection", "_update_by_sides _positions_by_height _boxes_from_eye"),
    *_of("kernels.box_fusion", "usual_covariances"),
    *_of("detections.projection", "_shifted_sides"),
    *_of("colouring.cuboid_projection", "sample_edges bound_edges extend_to_corners halve_steps extend_bounds"),
    *_of("kernels.overlaps", "pair_gains"),
    *_of("detections.projection", "_hide_covered"),
    *_of("kernels.existence", "scores_of_sweep reported_odds scores_of_image"),
    *_of("kernels.box_fusion", "boxes_with_position boxes_with_area single_precision"),
    *_of("detections.projection", "_pair_uncontested"),
)
_TRACKING = _of("tracking.tracker", "add_gains_in_image gains_in_space without_twins _predict read read_no_slip")
_OF_SCENES = {"fuse": (), "depth": _DEPTH, "colour": _COLOUR, "calibrate": _CALIBRATION, "deskew": ()}
_OF_BOXES = {"detections": _DETECTIONS, "track": (*_DETECTIONS, *_TRACKING)}


def compile_for(job: str, scene: "Scene") -> None:
    """Compile the kernels that are not kept yet and that a job needs with the sensors of a scene.

    Args:
        job: `fuse`, `depth`, `colour`, `calibrate` or `deskew`.
        scene: what it reads.
    """
    if not scene.lidars:
        return
    moving = _of("kernels.poses", "transform_by_path")
    placed = scene.trajectories or any(lidar.poses is not None for lidar in scene.lidars)
    odometry = () if placed else _ODOMETRY
    if job == "deskew":
        compile_ahead([*moving, *_READING, *odometry])
        return
    kernels = {"depth": "unproject_pixels", "calibrate": "project_points unproject_pixels"}
    models = {sensor.camera.model for sensor in scene.cameras}
    cameras = _of_cameras(models, f"project_into_image {kernels.get(job, '')}")
    first, *further = _FUSION if scene.cameras else moving
    own = _OF_SCENES[job]
    compile_ahead([*own[:2], first, *cameras, *_READING, *odometry, *further, *own[2:]])


@contextmanager
def compiling_for_demo() -> Iterator[Callable[[], None]]:
    """Compile what simulating the demo's drive needs and then, while that is at work, what fusing it needs.

    Yields:
        what waits until the drive can be simulated; leaving the block waits for the rest.
    """
    models = ("brown_conrady", "fisheye")
    simulating = [*_CASTING, *_of_cameras(models, "unproject_pixels"), *_of_cameras(models[:1], "fold_radius")]
    cubes = _of("kernels.voxels", "number_cubes first_of_cubes")
    fusing = [_FUSION[0], *_of_cameras(models, "project_into_image"), *_READING, *_FUSION[1:], *cubes]
    with compiling_ahead([*simulating, *fusing]) as wait:
        yield partial(wait, simulating)


def compile_for_boxes(job: str) -> None:
    """Compile the kernels that are not kept yet and that fusing detections needs.

    Args:
        job: `detections`, or `track`.
    """
    # of cameras those of KITTI, which are pinholes
    own = _OF_BOXES[job]
    compile_ahead([own[0], *_of_cameras(["pinhole"], "project_points unproject_pixels"), *own[1:]])


def _of_cameras(models: Iterable[str], kernels: str) -> list[str]:
    """Kernels of camera models; those that are not known are refused by the job."""
    return [
        f"{MODELS[name].module}:{''.join(word.capitalize() for word in name.split('_'))}.{kernel}"
        for name in sorted(MODELS.keys() & set(models))
        for kernel in kernels.split()
    ]
