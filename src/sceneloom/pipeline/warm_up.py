"""The kernels that a job needs: a first run compiles them at once, on all processors, and not one after another.

A kernel that is missing here is compiled when it is called, as any other. Within a group those that take longest come
first.
"""

from typing import TYPE_CHECKING

from sceneloom.cameras.camera import MODELS
from sceneloom.kernels.cache import compile_ahead

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
_ODOMETRY = (
    *_of("kernels.scan_matching", "accumulate_normal_equations describe_surfaces"),
    *_of("kernels.scan_matching", "insert_points move_points"),
)
_READING = (*_of("kernels.images", "rgb_from_halved_chroma"), *_of("kernels.packed", "unpack"))
_DEPTH = _of(
    "colouring.depth_completion",
    "triangulate fill_triangles measure_triangles link_pixels smooth_rightward smooth_downward grade_depths "
    "widen_samples fill_down fill_across measure_slopes hilbert_codes look_up",
)
_COLOUR = (
    *_of("colouring.blending", "weigh_samples mark_outlines"),
    *_of("colouring.exposure", "measure_contrasts"),
    *_of("kernels.projection", "sample_between_pixels"),
    *_of("kernels.voxels", "number_cubes"),
)
_DEMO = (
    *_of("simulate.painting", "paint_rays"),
    *_of("simulate.raycast", "trace_rays"),
    *_of("kernels.voxels", "number_cubes first_of_cubes"),
)
_JOBS = {"fuse": (), "depth": _DEPTH, "colour": _COLOUR, "demo": _DEMO}


def compile_for(job: str, scene: "Scene") -> None:
    """Compile the kernels that are not kept yet and that a job needs with the sensors of a scene.

    Args:
        job: `fuse`, `depth`, `colour`, or `demo`, whose scene is a simulated one.
        scene: what it reads.
    """
    if not scene.lidars:
        return
    models = {sensor.camera.model for sensor in scene.cameras} & MODELS.keys()  # others are refused by the job
    cameras = [
        f"{MODELS[name].module}:{''.join(word.capitalize() for word in name.split('_'))}.{kernel}"
        for name in sorted(models)
        for kernel in ("project_into_image", *(("unproject_pixels",) if job in {"depth", "demo"} else ()))
    ]
    placed = scene.trajectories or any(lidar.poses is not None for lidar in scene.lidars)
    odometry = () if placed else _ODOMETRY
    fusion = _FUSION if scene.cameras else _of("kernels.poses", "transform_by_path")
    first, *further = fusion
    compile_ahead([*_JOBS[job][:2], first, *cameras, *_READING, *odometry, *further, *_JOBS[job][2:]])
