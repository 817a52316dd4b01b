"""Every model against a slow oracle: plain numbers, one point at a time, written from the formulas' sources."""

import cmath
import math
from collections.abc import Callable

import numpy as np
import pytest

from sceneloom.cameras import MODELS, Camera, domain_angle, project_unbounded, unproject

SIZE = (1280, 960, 410.0, 402.0, 633.2, 471.7)
ROUNDING_PX = 1e-9  # 1e-16 of some 1e3 px, through some tens of operations and camera models that magnify
Oracle = Callable[[dict[str, float], float, float, float], complex]
"""Named coefficients and a point give the location on the plane as x + iy, before focal lengths and centre."""


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
    return bent + n["s"] * bent.imag / SIZE[2]  # the skew is in pixels


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
    return bent + complex(n["dcx"] / SIZE[2], n["dcy"] / SIZE[3])


def ftheta(n, X, Y, Z):
    angle, toward = polar(X, Y, Z)
    pixels = n["k1"] + n["k2"] * angle + n["k3"] * angle**2 + n["k4"] * angle**3 + n["k5"] * angle**4
    return complex(pixels * toward.real / SIZE[2], pixels * toward.imag / SIZE[3])


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
        fisheye_rad_tan_prism, fisheye_radial_custom, ftheta, kannala_brandt18, omnidir,
    )
}  # fmt: skip

FISHEYE = (0.05, -0.02, 0.01, -0.003)
BROWN = (0.2, 0.1, 1e-3, -2e-3, 0.02, 0.4, 0.1, 0.02, 0.01, -0.02, 1e-3, 2e-3, -1e-3, 5e-4, 0.02, -0.03)
SIX = (*FISHEYE, 4e-4, -3e-5)
ASYMMETRIC = (0.01, 0.002, -0.001, 0.3, -0.2, 0.1, 0.4, 0.01, -0.02, 0.001, 0.2, 0.3, -0.1, 0.2)

CAMERA_MODELS = [
    ("pinhole", ()),
    ("brown_conrady", ()),
    ("brown_conrady", (-0.3, 0.1, 0.001, -0.002, -0.01)),
    ("brown_conrady", BROWN[:8]),
    ("brown_conrady", BROWN[:10]),
    ("brown_conrady", BROWN),
    ("fisheye", ()),
    ("fisheye", FISHEYE),
    ("mod_equi_fish", ()),
    ("mod_equi_fish", (9.0, -0.03, 0.01, -0.002)),  # k1 takes no part
    ("mod_kannala", ()),
    ("mod_kannala", (0.1, -0.05, 0.02, -0.01)),
    ("cylindrical", ()),
    ("equirectangular", ()),
    ("omnidirectional", ()),
    ("omnidirectional", (-0.2, 0.05, 0.01, 0.002, 1e-3, -2e-3, 0.6, 0.01, -0.02)),
    ("omnidirectional", (-0.1, 0.03, 0.002, -4e-4, 1e-3, -2e-3, 1.7, 0.01, -0.02)),
    ("fisheye_rad_tan_prism", SIX),
    ("fisheye_rad_tan_prism", (*SIX, 1e-3, -2e-3, 1.5e-3, 2e-4, -1e-3, 3e-4)),
    ("fisheye_radial_custom", (*SIX, 1e-3, -2e-3, 3.5, -2.5)),
    ("ftheta", (0.0, 420.0, 3.0, -5.0, -2.0)),
    ("ftheta", (-2.5, 420.0)),
    ("kannala_brandt18", FISHEYE),
    ("kannala_brandt18", (*FISHEYE, *ASYMMETRIC)),
    ("omnidir", (-0.2, 0.05, 0.0, 1.0)),
    ("omnidir", (-0.2, 0.05, 1.3, 1.2, 1e-3, -2e-3)),
]
EACH_CAMERA_MODEL = pytest.mark.parametrize(
    ("model", "coefficients"), CAMERA_MODELS, ids=[f"{model}-{len(numbers)}" for model, numbers in CAMERA_MODELS]
)


def expected_pixel(camera: Camera, point: np.ndarray) -> tuple[float, float]:
    names = MODELS[camera.model].coefficient_names
    named = {**dict.fromkeys(names, 0.0), **dict(zip(names, camera.coefficients, strict=False))}
    location = ORACLES[camera.model](named, *map(float, point))
    return camera.fx * location.real + camera.cx, camera.fy * location.imag + camera.cy


def points_in_domain(camera: Camera, count: int, *, widest: float = 0.9) -> np.ndarray:
    """Random points inside most of the model's domain, at 1 to 50 m; of perspective models not at the very side."""
    random = np.random.default_rng(0)
    reach = min(domain_angle(camera), 1.35 if camera.model in {"pinhole", "brown_conrady"} else math.pi)
    angle, about = random.uniform(0.02, widest * reach, count), random.uniform(0, 2 * math.pi, count)
    rays = np.column_stack([np.sin(angle) * np.cos(about), np.sin(angle) * np.sin(about), np.cos(angle)])
    return rays * random.uniform(1, 50, (count, 1))


def test_every_model_has_an_oracle_and_a_camera_model():
    assert set(ORACLES) == set(MODELS) == {model for model, _ in CAMERA_MODELS}


@EACH_CAMERA_MODEL
def test_pixels_are_those_of_the_formulas_and_look_at_their_points(model, coefficients):
    camera = Camera(model, *SIZE, coefficients)
    points = points_in_domain(camera, 400)
    expected = np.array([expected_pixel(camera, point) for point in points])
    assert np.allclose(project_unbounded(camera, points), expected, rtol=1e-12, atol=ROUNDING_PX)
    toward = points / np.linalg.norm(points, axis=1, keepdims=True)
    assert np.abs(unproject(camera, expected) - toward).max() < 1e-9  # a millionth of a pixel
