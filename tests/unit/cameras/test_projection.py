"""What all models promise: formulas, against a slow oracle written from their sources; edges, domains, the hot path."""

import cmath
import math
import subprocess
import sys
from collections.abc import Callable

import numpy as np
import pytest

from sceneloom.cameras import MODELS, Camera, PointsInImage, check_camera, domain_angle, intrinsics_vector
from sceneloom.cameras.projection import project, project_unbounded, projection_kernel, unproject
from sceneloom.errors import ArrayError, CalibrationError
from sceneloom.kernels.projection import map_directions

SIZE = (640, 480, 500.0, 510.0, 318.7, 243.2)
BARREL = (-0.3, 0.1, 0.001, -0.002, -0.01)
EVERYTHING = (0.2, 0.1, 0.001, -0.002, 0.02, 0.4, 0.1, 0.02, 0.01, -0.02, 1e-3, 2e-3, -1e-3, 5e-4, 0.02, -0.03)
SIX = (0.05, -0.02, 0.01, -0.003, 4e-4, -3e-5)
ASYMMETRIC = (0.01, 0.002, -0.001, 0.3, -0.2, 0.1, 0.4, 0.01, -0.02, 0.001, 0.2, 0.3, -0.1, 0.2)
CAMERAS = [
    Camera("pinhole", *SIZE),
    Camera("brown_conrady", *SIZE),
    Camera("brown_conrady", *SIZE, BARREL),
    Camera("brown_conrady", *SIZE, EVERYTHING[:8]),
    Camera("brown_conrady", *SIZE, EVERYTHING[:10]),
    Camera("brown_conrady", *SIZE, EVERYTHING),
    Camera("fisheye", *SIZE),
    Camera("fisheye", *SIZE, (0.05, -0.02, 0.01, -0.003)),
    Camera("fisheye", 640, 480, 140.0, 140.0, 319.5, 239.5, (-0.01, 0.002)),
    Camera("mod_equi_fish", *SIZE, (0.0, -0.05, 0.02, -0.003)),
    Camera("mod_kannala", *SIZE, (0.05, -0.02, 0.01)),
    Camera("cylindrical", *SIZE),
    Camera("equirectangular", *SIZE),
    Camera("omnidirectional", *SIZE, (-0.1, 0.03, 0.002, -4e-4, 1e-3, -2e-3, 0.8, 0.01, -0.02)),
    Camera("omnidirectional", 640, 480, 640.0, 640.0, 319.5, 239.5, (0.0,) * 6 + (1.3,)),
    Camera("fisheye_rad_tan_prism", *SIZE, (*SIX, 1e-3, -2e-3, 1.5e-3, 2e-4, -1e-3, 3e-4)),
    Camera("fisheye_rad_tan_prism", *SIZE, SIX),
    Camera("fisheye_radial_custom", *SIZE, (*SIX, 1e-3, -2e-3, 3.5, -2.5)),
    Camera("ftheta", *SIZE, (0.0, 505.0, 3.0, -5.0, -2.0)),
    Camera("ftheta_skewed", *SIZE, (0.0, 0.012, -0.03, 0.008, -0.002, 2.5, -3.5)),
    Camera("kannala_brandt18", *SIZE, SIX[:4]),
    Camera("kannala_brandt18", *SIZE, (*SIX[:4], *ASYMMETRIC)),
    Camera("omnidir", *SIZE, (-0.1, 0.02, 1.3, 1.2, 1e-3, -2e-3)),
]
NAMES = [f"{camera.model}-{len(camera.coefficients)}-{camera.fx:g}" for camera in CAMERAS]
EACH_CAMERA = pytest.mark.parametrize("camera", CAMERAS, ids=NAMES)
ROUNDING_PX = 1e-9  # 1e-16 of some 1e3 px, through some tens of operations and camera models that magnify
Oracle = Callable[[dict[str, float], float, float, float], complex]
"""Named numbers and a point give the location on the plane as x + iy, before focal lengths and centre."""


def polar(x: float, y: float, z: float) -> tuple[float, complex]:
    """The angle off the axis, and the direction from the centre as a number of size 1."""
    return math.atan2(math.hypot(x, y), z), cmath.rect(1.0, math.atan2(y, x))


def odd_polynomial(angle: float, factors: list[float]) -> float:
    return angle + sum(k * angle ** (2 * i + 3) for i, k in enumerate(factors))


def pinhole(_, X, Y, Z):
    return complex(X / Z, Y / Z)


def brown_conrady(n, X, Y, Z):
    """Word by word: r² of the plain point, then the shift, then radial and tangential, then prism, then tilt."""
    x, y = X / Z, Y / Z
    r2 = x**2 + y**2
    x, y = x + n["lx"], y + n["ly"]
    above = 1 + n["k1"] * r2 + n["k2"] * r2**2 + n["k3"] * r2**3
    radial = above / (1 + n["k4"] * r2 + n["k5"] * r2**2 + n["k6"] * r2**3)
    xd = x * radial + 2 * n["p1"] * x * y + n["p2"] * (r2 + 2 * x**2) + n["s1"] * r2 + n["s2"] * r2**2
    yd = y * radial + n["p1"] * (r2 + 2 * y**2) + 2 * n["p2"] * x * y + n["s3"] * r2 + n["s4"] * r2**2
    tx, ty = n["tx"], n["ty"]
    about_x = np.array([[1, 0, 0], [0, math.cos(tx), math.sin(tx)], [0, -math.sin(tx), math.cos(tx)]])
    about_y = np.array([[math.cos(ty), 0, -math.sin(ty)], [0, 1, 0], [math.sin(ty), 0, math.cos(ty)]])
    rotation = about_y @ about_x
    onto_plane = np.array([[rotation[2, 2], 0, -rotation[0, 2]], [0, rotation[2, 2], -rotation[1, 2]], [0, 0, 1]])
    tilted = onto_plane @ rotation @ (xd, yd, 1.0)
    return complex(tilted[0] / tilted[2], tilted[1] / tilted[2])


def fisheye(n, X, Y, Z):
    angle, toward = polar(X, Y, Z)
    return odd_polynomial(angle, [n["k1"], n["k2"], n["k3"], n["k4"]]) * toward


def mod_equi_fish(n, X, Y, Z):
    angle, toward = polar(X, Y, Z)
    return (angle + n["k2"] * angle**3 + n["k3"] * angle**4 + n["k4"] * angle**5) * toward


def mod_kannala(n, X, Y, Z):
    angle, toward = polar(X, Y, Z)
    return math.tan(odd_polynomial(math.atan(angle), [n["k1"], n["k2"], n["k3"], n["k4"]])) * toward


def cylindrical(_, X, Y, Z):
    return complex(math.atan2(X, Z), Y / math.hypot(X, Z))


def equirectangular(_, X, Y, Z):
    return complex(math.atan2(X, Z), math.asin(Y / math.hypot(X, Y, Z)))


def on_shifted_sphere(xi, X, Y, Z):
    distance = math.hypot(X, Y, Z)
    return complex(X / distance, Y / distance) / (Z / distance + xi)


def decentred(location: complex, r2: float, radial: float, p1: float, p2: float) -> complex:
    x, y = location.real, location.imag
    return complex(
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    )


def omnidirectional(n, X, Y, Z):
    location = on_shifted_sphere(n["xi"], X, Y, Z)
    r2 = abs(location) ** 2
    radial = 1 + n["k1"] * r2 + n["k2"] * r2**2 + n["k3"] * r2**3 + n["k4"] * r2**4
    return decentred(location + complex(n["lx"], n["ly"]), r2, radial, n["p1"], n["p2"])


def omnidir(n, X, Y, Z):
    location = on_shifted_sphere(n["xi"], X, Y, Z)
    r2 = abs(location) ** 2
    bent = decentred(location, r2, 1 + n["k1"] * r2 + n["k2"] * r2**2, n["p1"], n["p2"])
    return bent + n["s"] * bent.imag / n["fx"]  # the skew is in pixels


def fisheye_rad_tan_prism(n, X, Y, Z):
    """Project Aria's documentation: both p are components of a vector t, which is not OpenCV's order."""
    angle, toward = polar(X, Y, Z)
    p = odd_polynomial(angle, [n[f"k{i}"] for i in range(1, 7)]) * toward
    t, r2 = complex(n["p1"], n["p2"]), abs(p) ** 2
    along = p.real * t.real + p.imag * t.imag
    prism = complex(n["s1"] * r2 + n["s2"] * r2**2, n["s3"] * r2 + n["s4"] * r2**2)
    return p + 2 * along * p + r2 * t + prism


def fisheye_radial_custom(n, X, Y, Z):
    angle, toward = polar(X, Y, Z)
    p = odd_polynomial(angle, [n[f"k{i}"] for i in range(1, 7)]) * toward
    bent = decentred(p, abs(p) ** 2, 1.0, n["p1"], n["p2"])
    return bent + complex(n["dcx"] / n["fx"], n["dcy"] / n["fy"])


def ftheta(n, X, Y, Z):
    angle, toward = polar(X, Y, Z)
    pixels = n["k1"] + n["k2"] * angle + n["k3"] * angle**2 + n["k4"] * angle**3 + n["k5"] * angle**4
    return complex(pixels * toward.real / n["fx"], pixels * toward.imag / n["fy"])


def ftheta_skewed(n, X, Y, Z):
    angle, toward = polar(X, Y, Z)
    p = (n["k0"] + angle + sum(n[f"k{i}"] * angle**i for i in (2, 3, 4, 5))) * toward
    return complex(p.real + n["skew_u"] / n["fx"] * p.imag, p.imag + n["skew_v"] / n["fy"] * p.real)


def kannala_brandt18(n, X, Y, Z):
    angle, toward = polar(X, Y, Z)
    phi = cmath.phase(toward)

    def part(powers: str, waves: str) -> float:
        growth = sum(n[f"{powers}{i}"] * angle ** (2 * i - 1) for i in (1, 2, 3))
        rotations = (math.cos(phi), math.sin(phi), math.cos(2 * phi), math.sin(2 * phi))
        return growth * sum(n[f"{waves}{i}"] * rotation for i, rotation in enumerate(rotations, start=1))

    radial = odd_polynomial(angle, [n[f"k{i}"] for i in range(4)]) + part("l", "i")
    return (radial + 1j * part("m", "j")) * toward


ORACLES: dict[str, Oracle] = {
    oracle.__name__: oracle
    for oracle in (
        pinhole, brown_conrady, fisheye, mod_equi_fish, mod_kannala, cylindrical, equirectangular, omnidirectional,
        fisheye_rad_tan_prism, fisheye_radial_custom, ftheta, ftheta_skewed, kannala_brandt18, omnidir,
    )
}  # fmt: skip


def points_before(
    camera: Camera, count: int, *, least: float = 0.0, widest: float = 0.95, reach: float = 2.8
) -> np.ndarray:
    """Random points inside most of the model's domain, at 1 to 50 m."""
    rng = np.random.default_rng(0)
    angle = rng.uniform(least, widest * min(domain_angle(camera), reach), count)
    about = rng.uniform(0, 2 * math.pi, count)
    rays = np.column_stack([np.sin(angle) * np.cos(about), np.sin(angle) * np.sin(about), np.cos(angle)])
    return rays * rng.uniform(1, 50, (count, 1))


ODD = [
    ("mod_equi_fish", ()),
    ("mod_equi_fish", (9.0, -0.03, 0.01, -0.002)),  # k1 takes no part
    ("mod_kannala", ()),
    ("mod_kannala", (0.1, -0.05, 0.02, -0.01)),
    ("omnidirectional", ()),
    ("omnidirectional", (-0.2, 0.05, 0.01, 0.002, 1e-3, -2e-3, 0.6, 0.01, -0.02)),
    ("omnidirectional", (-0.1, 0.03, 0.002, -4e-4, 1e-3, -2e-3, 1.7, 0.01, -0.02)),
    ("ftheta", (-2.5, 420.0)),
    ("ftheta_skewed", (-0.005, 0.02, -0.04)),
    ("omnidir", (-0.2, 0.05, 0.0, 1.0)),
]


@pytest.mark.parametrize(
    "camera",
    [*CAMERAS, *(Camera(model, 1280, 960, 410.0, 402.0, 633.2, 471.7, numbers) for model, numbers in ODD)],
    ids=[*NAMES, *(f"{model}-{len(numbers)}-odd" for model, numbers in ODD)],
)
def test_pixels_are_those_of_the_formulas_and_look_at_their_points(camera):
    assert set(ORACLES) == set(MODELS) == {camera.model for camera in CAMERAS}
    names, (*numbers, _) = ("fx", "fy", "cx", "cy", *MODELS[camera.model].coefficient_names), intrinsics_vector(camera)
    named = dict(zip(names, map(float, numbers), strict=True))
    # of perspective models not at the very side, nor in the middle, which an ftheta model may leave out
    reach = 1.35 if camera.model in {"pinhole", "brown_conrady"} else math.pi
    points = points_before(camera, 400, least=0.02, widest=0.9, reach=reach)
    found = np.array([ORACLES[camera.model](named, *map(float, point)) for point in points])
    expected = np.column_stack([camera.fx * found.real + camera.cx, camera.fy * found.imag + camera.cy])
    assert np.allclose(project_unbounded(camera, points), expected, rtol=1e-12, atol=ROUNDING_PX)
    toward = points / np.linalg.norm(points, axis=1, keepdims=True)
    assert np.abs(unproject(camera, expected) - toward).max() < 1e-9  # a millionth of a pixel


@EACH_CAMERA
def test_every_pixel_of_the_image_looks_along_a_ray_that_comes_back_to_it(camera):
    columns, rows = np.meshgrid(np.linspace(-0.5, 639.5, 41), np.linspace(-0.5, 479.5, 31))
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    assert np.abs(project_unbounded(camera, unproject(camera, pixels)) - pixels).max() < ROUNDING_PX
    vector, names = intrinsics_vector(camera), MODELS[camera.model].coefficient_names
    missing = [0.0] * (len(names) - len(camera.coefficients))
    assert vector[:-1].tolist() == [camera.fx, camera.fy, camera.cx, camera.cy, *camera.coefficients, *missing]
    assert not vector.flags.writeable
    if not {"lx", "ly", "dcx", "dcy"} & {*names[: len(camera.coefficients)]}:
        # a point on the axis falls on the principal point of a centred camera model
        pixels, visible = project(camera, [[0.0, 0.0, 3.0]])
        assert visible.all()
        assert np.allclose(pixels, [[camera.cx, camera.cy]], atol=ROUNDING_PX)


@EACH_CAMERA
def test_points_and_pixels_that_mean_nothing_are_never_seen(camera):
    points = np.tile([0.1, 0.1, 5.0], (9, 1))
    for k, (axis, value) in enumerate((a, v) for a in range(3) for v in (np.nan, np.inf, -np.inf)):
        points[k, axis] = value
    # squares of these overflow, or vanish, and would leave the axis
    huge = [[1e308, 1e308, 1e308], [1e200, 0.0, 1e200], [1e-300, 0.0, 1e-300]]
    assert np.isnan(project_unbounded(camera, [*points, *huge])).all()
    assert np.isnan(unproject(camera, [[1e308, 0.0], [-1e200, 1e200], [0.0, -1e160]])).all()
    # nor are the camera's own centre and the point right behind it
    pixels, visible = project(camera, [*points, [0.0, 0, 0], [0.0, 0, -1], [0.0, -0.0, -1e-300]])
    assert not visible.any()
    assert np.isnan(pixels).all()
    pixels, visible = project(camera, np.zeros((0, 3)))
    assert (pixels.shape, visible.shape, unproject(camera, np.zeros((0, 2))).shape) == ((0, 2), (0,), (0, 3))


def test_perspective_models_see_nothing_beside_or_behind_the_camera_and_a_fisheye_behind_its_own_plane():
    for model in ("pinhole", "brown_conrady"):
        _, visible = project(Camera(model, *SIZE), [[0, 0, 1e-3], [0, 0, 1e-7], [1, 0, 0], [0.1, 0.1, -1]])
        assert visible.tolist() == [True, False, False, False]
    camera, angle = Camera("fisheye", 640, 640, 140.0, 140.0, 319.5, 319.5), math.radians(110)
    pixels, visible = project(camera, [[math.sin(angle), 0.0, math.cos(angle)]])
    assert visible.all()
    assert np.allclose(pixels, [[319.5 + 140 * angle, 319.5]])
    assert unproject(camera, pixels)[0, 2] < 0


def test_the_edges_of_the_image_are_half_a_pixel_around_its_pixels_and_nothing_that_rounds_to_them_is_stored():
    camera = Camera("pinhole", 4, 2, 1.0, 1.0, 0.0, 0.0)
    inside = [(-0.5, -0.5), (3.4999, 1.4999), (0.0, -0.5), (-0.5, 1.0)]
    outside = [(-0.5001, 0.0), (3.5, 0.0), (0.0, -0.5001), (0.0, 1.5), (3.5, 1.5)]
    pixels, visible = project(camera, [(u, v, 1.0) for u, v in inside + outside])
    assert visible.tolist() == [True] * 4 + [False] * 5
    assert np.allclose(pixels[:4], inside)
    assert np.isnan(pixels[4:]).all()
    assert np.allclose(project_unbounded(camera, [(*outside[1], 1.0)]), [outside[1]])
    # the hot path stores nothing that rounds to the edge, and takes arrays that nobody may write
    camera = Camera("pinhole", 2048, 4, 1.0, 1.0, 0.0, 0.0)
    just_inside = np.nextafter(2047.5, 0.0)  # below the edge in float64, on it once rounded to float32
    points = np.array([[just_inside, 0.0, 1.0], [2047.0, 0.0, 1.0]])
    points.flags.writeable = False
    kept = run_kernel(camera, points, np.eye(4)[:3])
    assert kept.point_ids.tolist() == [1]
    assert np.floor(kept.pixels[0] + 0.5).tolist() == [2047, 0]


def test_what_lies_behind_a_fold_a_sphere_or_the_middle_of_a_polynomial_is_not_seen():
    # r - 0.3 r³ = 0.226 at r = 1.7: 113 px from the centre if it were believed
    assert 0 < 318.7 + 500 * (1.7 - 0.3 * 1.7**3) < 640
    _, visible = project(Camera("brown_conrady", *SIZE, (-0.3,)), [[1.7, 0.0, 1.0], [0.6, 0.0, 1.0]])
    assert visible.tolist() == [False, True]
    fold, camera = math.sqrt(1 / 0.9), Camera("brown_conrady", 2000, 2000, 500.0, 500.0, 999.5, 999.5, (-0.3,))
    largest = 500 * (fold - 0.3 * fold**3)
    rays = unproject(camera, [[999.5 + 0.999 * largest, 999.5], [999.5 + 1.001 * largest, 999.5]])
    assert np.isfinite(rays).all(axis=1).tolist() == [True, False]
    # the far side of the shifted sphere is hidden
    camera = Camera("omnidirectional", *SIZE, (0.0,) * 6 + (2.0,))
    edge = math.acos(-0.5)
    points = [[0.0, math.sin(angle), math.cos(angle)] for angle in (edge - 1e-3, edge + 1e-3, 3.1)]
    assert np.isfinite(project_unbounded(camera, points)).all(axis=1).tolist() == [True, False, False]
    farthest = SIZE[3] / math.sqrt(3.0)
    rays = unproject(camera, [[SIZE[4], SIZE[5] + 0.999 * farthest], [SIZE[4], SIZE[5] + 1.001 * farthest]])
    assert np.isfinite(rays).all(axis=1).tolist() == [True, False]
    # what an ftheta polynomial leaves out of the middle, or takes through it, is not seen
    camera = Camera("ftheta", *SIZE, (5.0, 300.0))
    assert np.isnan(project_unbounded(camera, [[0.0, 0.0, 1.0]])).all()
    rays = unproject(camera, [[SIZE[4] + off, SIZE[5]] for off in (0.0, 4.9, 5.1)])
    assert np.isfinite(rays).all(axis=1).tolist() == [False, False, True]
    camera = Camera("ftheta", *SIZE, (-30.0, 300.0))  # negative up to 0.1 rad
    points = [[math.sin(angle), 0.0, math.cos(angle)] for angle in (0.0, 0.05, 0.1 - 1e-9, 0.11)]
    assert np.isfinite(project_unbounded(camera, points)).all(axis=1).tolist() == [False, False, False, True]
    # a camera model that folds at its centre sees nothing
    for model, coefficients in [
        ("brown_conrady", (0.0, 0.0, 10.0, 10.0, 0.0, 0.0, 0.0, 0.0, 3.0, -3.0)),
        ("fisheye_rad_tan_prism", (-1e6,)),
        ("kannala_brandt18", (0.0,) * 4 + (1.0, 0.0, 0.0, 9.0)),
        ("omnidirectional", (0.0, 0.0, 0.0, 0.0, 10.0, 10.0, 1.0, 3.0, -3.0)),
    ]:
        camera = Camera(model, *SIZE, coefficients)
        assert intrinsics_vector(camera)[-1] < 1e-2
        assert np.isnan(unproject(camera, [[10.0, 10.0], [600.0, 20.0]])).all()
    # coefficients that nearly vanish change nothing
    for tiny in [5e-324, 1e-200, -1e-200, 1e-31]:
        for model in ("brown_conrady", "fisheye"):
            plain = Camera(model, *SIZE, (0.1, 0.01, 0.001, 0.0))
            nearly = Camera(model, *SIZE, (0.1, 0.01, 0.001, tiny))
            points = points_before(plain, 20, widest=0.5)
            assert np.allclose(project_unbounded(plain, points), project_unbounded(nearly, points), atol=ROUNDING_PX)
        rational = Camera("brown_conrady", *SIZE, (0.1, 0, 0, 0, tiny, 0, 0, tiny))
        assert math.isinf(intrinsics_vector(rational)[-1])


@EACH_CAMERA
def test_the_area_factor_is_positive_all_over_the_domain(camera):
    points = points_before(camera, 2000, widest=0.98)
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    right = np.cross(points, [0.3, 1.0, 0.2])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    down = np.cross(points, right)
    step = 1e-6
    along = (project_unbounded(camera, points + step * right) - project_unbounded(camera, points - step * right)).T
    across = (project_unbounded(camera, points + step * down) - project_unbounded(camera, points - step * down)).T
    assert (along[0] * across[1] - along[1] * across[0] > 0).all()


def run_kernel(camera: Camera, points_world, camera_from_world):
    room = PointsInImage.room(len(points_world))
    for rows in room:
        rows.fill(-1)
    kernel, camera_model = projection_kernel(camera.model), intrinsics_vector(camera)
    kept = kernel(points_world, camera_from_world, camera_model, camera.width, camera.height, room)
    return room.part(0, kept)


POSE = np.array([[0.0, -1.0, 0.0, 0.4], [0.0, 0.0, -1.0, 1.5], [1.0, 0.0, 0.0, -0.7]])


@EACH_CAMERA
def test_the_hot_path_keeps_what_the_plain_way_sees_in_ascending_order(camera):
    points_world = np.random.default_rng(1).uniform((-20, -20, -3), (40, 20, 6), (5000, 3))
    points_world[::97] = np.nan
    points_camera = np.array([POSE[:, :3] @ point + POSE[:, 3] for point in points_world])
    pixels, visible = project(camera, points_camera)
    kept = run_kernel(camera, points_world, POSE)
    ids = kept.point_ids
    assert np.array_equal(ids, np.flatnonzero(visible))
    assert 100 < len(ids) < 4900
    assert np.abs(kept.pixels - pixels[ids]).max() < 4e-5  # float32 of up to 640 px
    assert np.allclose(kept.depths, points_camera[ids, 2], rtol=1e-7, atol=1e-6)
    columns, rows = np.floor(kept.pixels.astype(np.float64) + 0.5).T
    np.testing.assert_array_equal(kept.pixel_numbers, rows * camera.width + columns)
    assert_looks_as_mapped(kept, points_world, POSE)


def assert_looks_as_mapped(kept, points_world, camera_from_world):
    directions = np.empty((2, len(kept.point_ids)), np.float32)
    inverse_ranges = np.empty(len(kept.point_ids), np.float32)
    map_directions(points_world, kept.point_ids, camera_from_world, directions, inverse_ranges)
    # Of the doubles one may be rounded once less, which tips few of their float32.
    np.testing.assert_allclose([kept.rightward, kept.downward], directions, atol=5e-7)
    np.testing.assert_allclose(kept.inverse_ranges, inverse_ranges, rtol=5e-7)


@pytest.mark.parametrize("run", [1, 500, 512, 700])
@pytest.mark.parametrize("count", [1, 511, 512, 3001])
def test_runs_of_points_inside_and_outside_the_image_are_distinguished_wherever_they_end(run, count):
    camera = CAMERAS[0]
    points = np.random.default_rng(run).uniform((-0.2, -0.2, 1), (0.2, 0.2, 2), (count, 3))
    points[np.arange(count) // run % 2 == 1, 2] *= -1
    pixels, visible = project(camera, points)
    kept = run_kernel(camera, points, np.eye(4)[:3])
    np.testing.assert_array_equal(kept.point_ids, np.flatnonzero(visible))
    np.testing.assert_array_equal(kept.pixels, pixels[visible].astype(np.float32))
    np.testing.assert_array_equal(kept.depths, points[visible, 2].astype(np.float32))
    assert_looks_as_mapped(kept, points, np.eye(4)[:3])


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ((0, 480, 500.0, 500.0, 320.0, 240.0), "image size 0x480"),
        ((640, -1, 500.0, 500.0, 320.0, 240.0), "image size 640x-1"),
        ((640, 480, -500.0, 500.0, 320.0, 240.0), "focal lengths -500.0, 500.0"),
        ((640, 480, 500.0, 0.0, 320.0, 240.0), "focal lengths 500.0, 0.0"),
        ((640, 480, 500.0, float("nan"), 320.0, 240.0), "expected finite"),
        ((640, 480, 500.0, 500.0, float("inf"), 240.0), "expected finite"),
        ((640, 480, 500.0, 500.0, 320.0, 240.0, (0.1, float("nan"))), "expected finite"),
    ],
)
def test_numbers_that_are_no_camera_model_are_refused(numbers, message):
    with pytest.raises(CalibrationError, match=message):
        Camera("brown_conrady", *numbers)


@pytest.mark.parametrize(
    ("model", "coefficients", "message"),
    [
        ("pinhole", (0.0,), "1 distortion coefficients; pinhole has 0$"),
        ("fisheye", (0.0,) * 5, "5 distortion coefficients; fisheye has 4: k1 k2 k3 k4"),
        ("brown_conrady", (0.0,) * 17, "brown_conrady has 16: k1 k2 p1 p2"),
        ("brown_conrady", (1e300, 1e300), "expected no more than"),
        ("opencv", (), "'opencv'; expected one of pinhole, brown_conrady, fisheye"),
    ],
)
def test_unknown_models_too_many_or_too_large_coefficients_and_arrays_of_a_wrong_shape_are_refused(
    model, coefficients, message
):
    for use in (check_camera, intrinsics_vector, lambda camera: project(camera, np.zeros((1, 3)))):
        with pytest.raises(CalibrationError, match=message):
            use(Camera(model, *SIZE, coefficients))
    with pytest.raises(CalibrationError, match="expected one of pinhole"):
        projection_kernel("opencv")
    for function, wrong in ((project, np.zeros((3, 2))), (unproject, np.zeros(2))):
        with pytest.raises(ArrayError, match="expected \\(N, "):
            function(CAMERAS[0], wrong)


def test_an_image_of_another_size_shows_corners_and_centres_where_they_belong():
    def resized(model, width, height, *numbers, focal=300.0):
        return Camera(model, 640, 480, focal, focal, 319.5, 239.5, numbers).resized(width, height)

    fisheye = resized("fisheye", 1280, 120, 0.1, 0.2, focal=500.0)
    expected = Camera("fisheye", 1280, 120, 1000.0, 125.0, 639.5, 59.5, (0.1, 0.2))
    assert (fisheye, hash(fisheye)) == (expected, hash(expected))
    # coefficients in pixels grow with the image
    assert resized("omnidir", 1280, 480, 0.0, 0.0, 1.5, 1.1).coefficients == (0.0, 0.0, 3.0, 1.1)
    assert resized("fisheye_radial_custom", 1280, 240, *(0.0,) * 8, 2.0, -4.0).coefficients[8:] == (4.0, -2.0)
    assert resized("ftheta", 213, 160, 0.0, 300.0).coefficients[1] == pytest.approx(100.0, rel=1e-3)  # whole pixels
    with pytest.raises(CalibrationError, match="expected the same for both axes of a ftheta camera model"):
        resized("ftheta", 1280, 480, 0.0, 300.0)
    size, points = (640, 480, 300.0, 300.0, 319.5, 239.5), points_before(CAMERAS[0], 50, widest=0.5)
    for camera in (
        Camera("pinhole", 640, 480, 500.0, 510.0, 319.5, 250.0),
        Camera("ftheta", *size, (0.5, 300.0, 2.0, -3.0, -1.0)),
        Camera("omnidir", *size, (-0.1, 0.02, 1.5, 1.1, 1e-3, -1e-3)),
        Camera("ftheta_skewed", *size, (0.0, 0.01, -0.02, 0.0, 0.0, 2.0, -3.0)),
        Camera("fisheye_radial_custom", *size, (0.05, *(0.0,) * 5, 1e-3, -1e-3, 2.5, -1.5)),
    ):
        # measured from the image's corner, everything doubles or halves
        sizes = camera, camera.resized(1280, 960), camera.resized(320, 240)
        edges, *others = (project_unbounded(one, points) + 0.5 for one in sizes)
        assert np.isfinite(edges).all()
        np.testing.assert_allclose(others, [2 * edges, edges / 2])


def test_naming_the_models_does_not_load_the_compiler():
    program = "import sys, sceneloom.cameras; print('numba' in sys.modules)"
    printed = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert printed.strip() == "False"


REACH = {
    "pinhole": [((), math.pi / 2)],
    "brown_conrady": [
        ((), math.pi / 2),
        ((-0.3,), math.atan(math.sqrt(1 / 0.9))),  # r - 0.3 r³ grows up to here
        ((0, 0, 0, 0, 0, -0.25), math.atan(2.0)),  # the pole: 1 - r²/4 vanishes
    ],
    "fisheye": [((), math.pi), ((-0.2,), math.sqrt(1 / 0.6))],
    "mod_equi_fish": [((9.0, -0.2), math.sqrt(1 / 0.6)), ((0.0, 0.0, -0.1), (1 / 0.4) ** (1 / 3))],
    "mod_kannala": [((), math.pi), ((-0.5,), math.tan(math.sqrt(1 / 1.5)))],
    "ftheta": [((0.0, 300.0, -75.0), 2.0), ((3.0, -300.0), 0.0)],
    "ftheta_skewed": [((), math.pi), ((0.0, -0.25), 2.0)],
    "cylindrical": [((), math.pi)],
    "equirectangular": [((), math.pi)],
    "omnidirectional": [
        *(((0,) * 6 + (xi,), math.acos(-0.5)) for xi in (0.5, 2.0)),
        *((((0,) * 6 + (1.0,), math.pi)), ((0,) * 6 + (-2.0,), 0.0), ((), math.pi / 2)),
        ((-1 / 3,) + (0,) * 5 + (1.0,), 2 * math.atan(1.0)),
    ],
    "omnidir": [((0.0, 0.0, 5.0, 2.0), math.acos(-0.5))],
    "fisheye_rad_tan_prism": [((-0.2,), math.sqrt(1 / 0.6))],
    "fisheye_radial_custom": [((0.0, -0.04), (1 / 0.2) ** 0.25)],
    "kannala_brandt18": [
        ((-0.2,), math.sqrt(1 / 0.6)),
        ((0,) * 4 + (0.5, 0, 0, 0, 0, 3.0), 0.0),  # inward along y from the start
    ],
}


@pytest.mark.parametrize("model", REACH)
def test_camera_models_reach_as_far_as_paper_says(model):
    for coefficients, angle in REACH[model]:
        camera = Camera(model, *SIZE, tuple(map(float, coefficients)))
        assert domain_angle(camera) == pytest.approx(angle, abs=2e-6)
        if angle < 2.5:
            assert not project(camera, [[math.sin(angle + 0.3), 0.0, math.cos(angle + 0.3)]])[1].any()


def test_camera_models_that_are_not_radial_end_where_they_fold_first_in_any_direction():
    # With p1 = 0.1 in OpenCV's sense y' = y + 0.1 (x² + 3 y²): it rotates at y = -1/0.6, straight up.
    camera = Camera("fisheye_radial_custom", *SIZE, (0.0,) * 6 + (0.1, 0.0))
    # p1 of the other model is OpenCV's p2, which bends x.
    other = Camera("fisheye_rad_tan_prism", *SIZE, (0.0,) * 6 + (0.1, 0.0))
    assert (domain_angle(camera), domain_angle(other)) == pytest.approx((1 / 0.6, 1 / 0.6), rel=1e-3)
    beyond = 1 / 0.6 + 0.02
    assert np.isnan(project_unbounded(camera, [[0.0, -math.sin(beyond), math.cos(beyond)]])).all()
    # r = θ + θ (0.2 θ²)·(-1) along x only: l2 = 0.2, i3 = cos 2φ gives -1 along y and +1 along x.
    asymmetric = Camera("kannala_brandt18", *SIZE, (0.0,) * 4 + (0.0, 0.2, 0.0, 0.0, 0.0, 1.0))
    assert 0.5 < domain_angle(asymmetric) < math.sqrt(1 / 0.6)  # along y it folds there at the latest
    for size in (1e-3, 2e-4, 1e-5, 1e-6):
        # x' = x + 3 p2 x² along y = 0: it rotates at x = -1/(6 p2), and is back in the middle at twice that
        camera = Camera("brown_conrady", *SIZE, (0.0, 0.0, 0.0, size))
        # the limit is sought in steps of angles, whose tangents are 2 % apart here, and kept inside
        assert 0.97 / (6 * size) < math.tan(domain_angle(camera)) < 1 / (6 * size)
        seen = project_unbounded(camera, [[-0.9 / (6 * size), 0.0, 1.0], [-2 / (6 * size), 0.0, 1.0]])
        assert np.isnan(seen).all(axis=1).tolist() == [False, True]


def test_pixels_beyond_the_seam_or_the_pole_of_a_panorama_look_nowhere_and_nothing_is_seen_straight_up_or_down():
    for model in ("cylindrical", "equirectangular"):
        camera, edge = Camera(model, *SIZE), SIZE[2] * math.pi
        rays = unproject(camera, [[SIZE[4] + share * edge, 240.0] for share in (0.999, -1.001, 1.0)])
        assert np.isfinite(rays).all(axis=1).tolist() == [True, False, True]
        assert rays[0, 2] < -0.99
        pixels = project_unbounded(camera, [[0, 1, 0], [0, -3, 0], [1e-9, 1, 0], [1e-3, 1, 0]])
        assert np.isfinite(pixels).all(axis=1).tolist() == [False, False, False, True]
    rays = unproject(camera, [[300.0, SIZE[5] + share * SIZE[3] * math.pi / 2] for share in (-0.99, -1.01, 2.0)])
    assert np.isfinite(rays).all(axis=1).tolist() == [True, False, False]
    assert rays[0, 1] < -0.99
