"""What must hold for any cloud at all: no write beside the outputs, and decisions that obey geometry."""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sceneloom.cameras.camera import Camera
from sceneloom.colouring import ViewRequest, VisibilitySettings, find_visible, fuse_by_projection
from sceneloom.colouring import visibility as vis
from sceneloom.colouring.algorithms import mark_nearest
from sceneloom.colouring.blending import paint_points
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.kernels.projection import draw_depths, map_directions, pixel_numbers

GUARD = 64
STILL = np.eye(4)
FIXED = VisibilitySettings(window_deg=0.5, near_deg=0.3, surface_distance=0.5)
any_float32 = st.floats(width=32)
any_float = st.one_of(st.floats(), st.floats(-50, 50), st.sampled_from([0.0, -0.5, 0.5, 6.5, 1e-7, 1e308]))
coordinates = st.floats(-40, 40, width=32)
clouds = hnp.arrays(np.float64, st.tuples(st.integers(0, 40), st.just(3)), elements=any_float)


@st.composite
def tame_clouds(draw, least=0):
    """Points ahead, many of them close to each other in direction."""
    count = draw(st.integers(least, 40))
    rows = draw(hnp.arrays(np.float64, (count, 3), elements=st.floats(-1, 1, width=16)))
    spread = draw(st.sampled_from([0.003, 0.02, 0.5]))
    depths = 2.0 + 30 * np.abs(rows[:, 2])
    return np.column_stack([rows[:, 0] * spread * depths, rows[:, 1] * spread * depths, depths])


def guarded(shape, dtype, value):
    """An array in the middle of a larger one, and the function that checks what lies around it."""
    size = math.prod(shape)
    whole = np.full(size + 2 * GUARD, value, dtype)
    untouched = np.concatenate([whole[:GUARD], whole[-GUARD:]])

    def check() -> None:
        np.testing.assert_array_equal(np.concatenate([whole[:GUARD], whole[-GUARD:]]), untouched)

    return whole[GUARD : GUARD + size].reshape(shape), check


@given(
    points=clouds,
    ids=hnp.arrays(
        np.int64, st.integers(0, 50), elements=st.one_of(st.integers(-3, 45), st.integers(-(2**63), 2**63 - 1))
    ),
)
def test_directions_of_any_points_stay_in_the_map_and_in_the_outputs(points, ids):
    directions, check_directions = guarded((2, len(ids)), np.float32, 7)
    inverse_ranges, check_ranges = guarded((len(ids),), np.float32, 7)
    map_directions(points, ids, STILL, directions, inverse_ranges)
    check_directions()
    check_ranges()
    assert (np.hypot(*directions) <= 2.001).all()
    assert ((inverse_ranges >= 0) & np.isfinite(inverse_ranges)).all()


@given(
    rows=hnp.arrays(
        np.float32,
        st.tuples(st.just(3), st.integers(0, 60)),
        elements=st.one_of(any_float32, st.floats(-2, 2, width=32), st.floats(0, 0.015625, width=32)),
    ),
    window_deg=st.sampled_from([0.3, 2.5]),
    known_trajectory=st.booleans(),
)
def test_visibility_of_any_directions_stays_in_its_output(rows, window_deg, known_trajectory):
    visible, check = guarded((rows.shape[1],), np.bool_, True)
    near = math.radians(0.3) ** -2
    cell = math.radians(0.16)
    eyes = np.array([[0.1, -0.5, 0.3], [0.2, -0.4, math.inf]])[: 2 if known_trajectory else 0]
    ids, fractions = np.arange(rows.shape[1]), np.ones(rows.shape[1], np.float32)
    extent = vis.measure_extent(rows[:2], rows[2])
    hiding = vis.Hiding(rows[2], cell, math.radians(window_deg), near, 0.0, near)
    vis.mark_unhidden(
        rows[:2], rows[2], [hiding], extent, 2.0, 0.15, 0.01,
        eyes, ids, fractions, 0.85, visible,
    )  # fmt: skip
    check()
    takes_part = (rows[2] > 0) & np.isfinite(rows[2]) & (np.abs(rows[:2]) <= 2.1).all(axis=0)
    ends = [(some.min(), some.max()) if len(some) else (math.inf, -math.inf) for some in rows[:2, takes_part]]
    assert extent.tolist() == [end for pair in ends for end in pair]
    assert not visible[~takes_part].any()
    assert visible[takes_part].any() == takes_part.any()


@given(
    rows=hnp.arrays(
        np.float32,
        st.tuples(st.just(3), st.integers(0, 60)),
        elements=st.one_of(any_float32, st.floats(-2, 2, width=32)),
    )
)
def test_what_is_measured_in_any_directions_is_within_bounds_or_unknown(rows):
    neighbours = vis.look_around(rows[:2], rows[2])
    assert 0.1 <= vis.measure_surface_distance(neighbours, rows[:2], rows[2], 0.1, 0.1) <= 1.5
    spacings = vis.measure_spacings(neighbours)
    assert (np.isnan(spacings) | ((spacings > 0) & (spacings <= math.radians(2.6)))).all()


@given(
    pixels=hnp.arrays(
        np.float32,
        st.tuples(st.integers(0, 40), st.just(2)),
        elements=st.one_of(any_float32, st.sampled_from([-0.5, 0.5, 0.49999997, 2.5, 6.5, 6.4999995])),
    ),
    size=st.sampled_from([(1, 1), (1, 7), (3, 1), (3, 7)]),
    data=st.data(),
)
def test_images_and_colours_are_written_nowhere_else(pixels, size, data):
    count = len(pixels)
    depths = data.draw(hnp.arrays(np.float32, count, elements=any_float32))
    visible = data.draw(hnp.arrays(np.bool_, count))
    ids = data.draw(hnp.arrays(np.int64, count, elements=st.integers(-2, 12)))
    image, check_image = guarded(size, np.float32, 0)
    nearest, check_nearest = guarded((count,), np.bool_, True)
    colors, check_colors = guarded((10, 3), np.uint8, 255)
    camera_index, check_index = guarded((10,), np.uint8, 255)
    best, check_best = guarded((10,), np.float64, math.inf)
    numbers = pixel_numbers(pixels, size[1], size[0])
    numbers[::7] = data.draw(st.integers(-(2**31), 2**31 - 1))
    draw_depths(numbers, depths, visible, image)
    mark_nearest(numbers, depths, image, nearest)
    shown, rows = np.full((*size, 3), 9, np.uint8), (0, 0, len(ids))
    paint_points(ids, pixels, numbers, visible, shown, 1, best, colors, camera_index, *rows)
    for check in (check_image, check_nearest, check_colors, check_index, check_best):
        check()
    assert ((image >= 0) & np.isfinite(image)).all()
    assert ((camera_index == 1) == (colors == 9).all(axis=1)).all()


@given(points=clouds, size=st.sampled_from([(1, 1), (40, 30), (1, 100)]), enabled=st.booleans())
def test_any_cloud_can_be_fused(points, size, enabled):
    camera = Camera("pinhole", *size, 20.0, 20.0, (size[0] - 1) / 2, (size[1] - 1) / 2)
    rgb = np.full((size[1], size[0], 3), 3, np.uint8)
    stated = {"camera_id": 0, "camera_index": 0, "timestamp_ns": 0, "world_from_camera": RigidTransform.identity()}
    request = ViewRequest(camera=camera, rgb=rgb, **stated)
    fused = fuse_by_projection(points, [request], VisibilitySettings(enabled=enabled))
    view = fused.views[0]
    seen = np.zeros(len(points), bool)
    seen[view.point_ids[view.visible]] = True
    assert ((fused.camera_index == 0) == seen).all()
    assert (view.depth_image > 0).sum() <= view.visible.sum()
    # Beyond a million kilometres, or nearer than a micrometre, nothing is seen.
    sane = (view.depths > 1e-5) & (view.depths < 1e8)
    assert view.visible.any() or not sane.any()


@given(points=tame_clouds(least=1), seed=st.integers(0, 99))
def test_neither_order_nor_unit_nor_a_point_behind_all_others_matter_and_the_nearest_point_is_visible(points, seed):
    # Equally near points of a cell are distinguished by their order only.
    points = points * (1 + 1e-3 * np.arange(len(points)))[:, None]
    order, ids = np.random.default_rng(seed).permutation(len(points)), np.arange(len(points))
    visible = find_visible(points, ids, STILL, FIXED)
    assert visible[np.argmin(np.linalg.norm(points, axis=1))]
    np.testing.assert_array_equal(find_visible(points[order].copy(), ids, STILL, FIXED), visible[order])
    more = np.concatenate([points, [[0.01, 0.02, 90.0]]])
    np.testing.assert_array_equal(find_visible(more, np.arange(len(more)), STILL, FIXED)[:-1], visible)
    in_quarters = VisibilitySettings(
        window_deg=0.5, near_deg=0.3, surface_distance=4 * FIXED.surface_distance, margin=4 * FIXED.margin
    )
    # Powers of two change no digit of any sum.
    np.testing.assert_array_equal(find_visible(4 * points, ids, STILL, in_quarters), visible)
