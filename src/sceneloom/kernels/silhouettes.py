"""How many pixels each object would fill if nothing stood before it: the other side of what an image shows."""

import numpy as np
from numba import njit, prange

from sceneloom.arrays import Float64Array, Int64Array, UInt8Array
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.raycast import INNER, Int32Array, bundle_cone, cull, meet_shape, take_into_frame


@njit(**INNER)
def _count_bundle(
    directions: Float64Array, pose_of_ray: Int32Array, rotations: Float64Array, origins: Float64Array,
    start: int, stop: int, kinds: UInt8Array, maps: Float64Array, object_of_shape: Int32Array,
    frame_of_shape: Int32Array, frames: Float64Array, spheres: Float64Array, candidates: Int32Array, reach: float,
    counts: Int64Array,
) -> None:  # fmt: skip
    """Count the rays from `start` to `stop`; arguments as in `count_silhouettes`."""
    rays, axis, own = np.empty((stop - start, 3)), np.empty(3), np.empty(6)
    cosine, spread = bundle_cone(directions, pose_of_ray, rotations, origins, start, stop, rays, axis)
    chosen, nears = np.empty(len(candidates), np.int32), np.empty(len(candidates))
    count = cull(axis, cosine, origins[pose_of_ray[start]], spread, spheres, candidates, reach, chosen, nears)
    # The shapes of an object follow each other, so a ray that has met it once is known by the object before.
    chosen = np.sort(chosen[:count])
    for k in range(start, stop):
        x, y, z = origins[pose_of_ray[k], 0], origins[pose_of_ray[k], 1], origins[pose_of_ray[k], 2]
        u, v, w = rays[k - start, 0], rays[k - start, 1], rays[k - start, 2]
        met = -1
        for shape in chosen:
            thing = object_of_shape[shape]
            if thing == met:
                continue
            if frame_of_shape[shape] < 0:
                t = meet_shape(kinds[shape], maps[shape], x, y, z, u, v, w, reach)
            else:
                take_into_frame(frames[pose_of_ray[k], frame_of_shape[shape]], x, y, z, u, v, w, own)
                t = meet_shape(
                    kinds[shape], maps[shape], own[0], own[1], own[2], own[3], own[4], own[5], reach
                )
            if t < reach:
                counts[thing] += 1
                met = thing


@kernel(
    "void(float64[:,::1], int32[::1], float64[:,:,::1], float64[:,::1], int64[::1], uint8[::1], float64[:,:,::1], "
    "int32[::1], int32[::1], float64[:,:,:,::1], float64[:,::1], int32[::1], float64, int64[:,::1])",
    parallel=True,
    nogil=True,
    cache=True,
    error_model="numpy",
)
def count_silhouettes(
    directions: Float64Array, pose_of_ray: Int32Array, rotations: Float64Array, origins: Float64Array,
    bundle_starts: Int64Array, kinds: UInt8Array, maps: Float64Array, object_of_shape: Int32Array,
    frame_of_shape: Int32Array, frames: Float64Array, spheres: Float64Array, candidates: Int32Array, reach: float,
    counts: Int64Array,
) -> None:  # fmt: skip
    """Count for each object the rays that would meet it if it were alone.

    Args:
        object_of_shape: (P,) int32, counted from 0; the shapes of one object follow each other.
        counts: (W, objects) int64, added to: the sum over the rows is the answer; W workers share the bundles.

    The other arguments are those of `trace_rays`.
    """
    workers, bundles = counts.shape[0], len(bundle_starts) - 1
    for worker in prange(workers):
        for bundle in range(worker, bundles, workers):
            _count_bundle(
                directions, pose_of_ray, rotations, origins, bundle_starts[bundle], bundle_starts[bundle + 1], kinds,
                maps, object_of_shape, frame_of_shape, frames, spheres, candidates, reach, counts[worker],
            )  # fmt: skip
