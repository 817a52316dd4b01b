"""The things that stand along the street, each built from a few shapes in a frame of its own.

An object's frame has x along its forward axis, y to its left, z up and the origin on the ground under its middle.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.simulate.path import rotation_from_angles
from sceneloom.simulate.shapes import Color, Material, Pattern, Shape, ShapeKind

_WALLS: tuple[Color, ...] = (
    (226, 205, 170), (204, 152, 124), (236, 226, 206), (178, 190, 196), (214, 178, 112), (190, 122, 100),
    (168, 182, 152), (222, 190, 186), (150, 160, 178), (240, 214, 150),
)  # fmt: skip
_ROOFS: tuple[Color, ...] = ((162, 78, 58), (120, 66, 56), (92, 92, 100), (140, 88, 66), (78, 84, 92))
_LACQUERS: tuple[Color, ...] = (
    (188, 40, 38), (42, 86, 164), (232, 232, 232), (60, 64, 70), (44, 122, 84), (224, 176, 50), (150, 156, 164),
    (110, 44, 90), (32, 136, 158), (236, 118, 44),
)  # fmt: skip
_LEAVES: tuple[tuple[Color, Color, Color], ...] = (
    ((62, 110, 48), (104, 150, 62), (172, 196, 104)),
    ((48, 92, 56), (82, 128, 70), (142, 176, 110)),
    ((116, 124, 44), (164, 158, 62), (212, 200, 110)),
)
_BIN_COLORS: tuple[Color, ...] = ((40, 90, 60), (60, 66, 74), (60, 80, 140), (150, 110, 40))
_WHITE: Color = (240, 240, 236)
_GLASS: Color = (66, 84, 104)
_DARK: Color = (34, 36, 40)
_STEEL: Color = (150, 156, 160)


@dataclass(frozen=True, slots=True, eq=False)
class Design:
    """An object before it has a location.

    Attributes:
        label: the object's class.
        shapes: in the object's frame.
        size_lwh: length, width and height of the box around it [m].
        ahead: how far before the object's origin the middle of its box lies [m].
        plan_lw: length and width of the ground that it takes, where that is not all under its box [m].
    """

    label: str
    shapes: tuple[Shape, ...]
    size_lwh: tuple[float, float, float]
    ahead: float = 0.0
    plan_lw: tuple[float, float] | None = None

    def center(self, x: float, y: float, yaw: float) -> tuple[float, float, float]:
        """Middle of its box in the world where it stands at (x, y) [m], rotated by `yaw` [rad]."""
        return (
            float(x + self.ahead * np.cos(yaw)),
            float(y + self.ahead * np.sin(yaw)),
            self.size_lwh[2] / 2,
        )

    def plan(self, x: float, y: float, yaw: float) -> Float64Array:
        """Corners and middles of the sides of its ground plan in the world, (8, 2) [m]."""
        around = np.array([[1, 1], [0, 1], [-1, 1], [-1, 0], [-1, -1], [0, -1], [1, -1], [1, 0]])
        plan = around * (0.5 * np.array(self.plan_lw or self.size_lwh[:2]))
        rotation = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        corners: Float64Array = plan @ rotation.T + [x, y]
        return corners

    def placed(self, x: float, y: float, yaw: float) -> tuple[Shape, ...]:
        """Its shapes in the world, stationary at (x, y) [m] and rotated by `yaw` [rad]."""
        rotation = rotation_from_angles(np.zeros(()), np.zeros(()), np.asarray(yaw))
        world_from_object = RigidTransform(rotation, np.array([x, y, 0.0]))
        return tuple(shape.moved(world_from_object) for shape in self.shapes)


def _at(x: float, y: float, z: float) -> RigidTransform:
    return RigidTransform(np.eye(3), np.array([x, y, z]))


def _lying(x: float, y: float, z: float) -> RigidTransform:
    """A cylinder's pose with its axis along y."""
    quarter = rotation_from_angles(np.array(np.pi / 2), np.zeros(()), np.zeros(()))
    return RigidTransform(quarter, np.array([x, y, z]))


def _stationary(
    kind: ShapeKind, half: tuple[float, float, float], foot: Sequence[float], material: Material
) -> Shape:
    """A shape whose lowest point is at `foot`."""
    return Shape(kind, _at(foot[0], foot[1], foot[2] + half[2]), half, material)


def _pick(generator: np.random.Generator, choices: Sequence[Color]) -> Color:
    return choices[int(generator.integers(len(choices)))]


def _tinted(color: Color, factor: float) -> Color:
    red, green, blue = (min(255.0, factor * value) for value in color)
    return red, green, blue


def design_house(generator: np.random.Generator, *, length: float, depth: float, storeys: int) -> Design:
    """A house with rows of windows, plastered or of bricks, under a gabled roof along the street or a flat one."""
    storey = generator.uniform(2.7, 3.1)
    height, wall = storeys * storey + 0.4, _pick(generator, _WALLS)
    bricks = 0.22 if generator.uniform() < 0.4 else 0.0
    pitch = length / max(2, round(length / generator.uniform(2.2, 3.0)))
    facade = Material(Pattern.FACADE, (wall, _GLASS, _WHITE), (pitch, storey, bricks), 0.7)
    body = _stationary(ShapeKind.BOX, (length / 2, depth / 2, height / 2), (0, 0, 0), facade)
    if storeys <= 3 and generator.uniform() < 0.8:
        rise, tile = depth * generator.uniform(0.16, 0.26), _pick(generator, _ROOFS)
        tiles = Material(Pattern.TILES, (tile, _tinted(tile, 0.7), tile), reflectivity=0.45)
        half = (length / 2 + 0.25, depth / 2 + 0.35, rise)
        top = _stationary(ShapeKind.GABLE, half, (0, 0, height), tiles)
    else:
        rise = 0.2
        ledge = Material(Pattern.PLAIN, (_tinted(wall, 0.8),) * 3, reflectivity=0.6)
        top = _stationary(ShapeKind.BOX, (length / 2 + 0.2, depth / 2 + 0.2, rise), (0, 0, height), ledge)
    return Design("building", (body, top), (length + 0.5, depth + 0.7, height + 2 * rise))


def design_car(generator: np.random.Generator) -> Design:
    """A parked car: body, cabin and four wheels."""
    length, width = generator.uniform(3.9, 4.7), generator.uniform(1.7, 1.85)
    waist, height = generator.uniform(0.82, 0.92), generator.uniform(1.42, 1.6)
    lacquer = _pick(generator, _LACQUERS)
    body = Material(Pattern.CAR_BODY, (lacquer, _DARK, (244, 236, 214)), reflectivity=0.65)
    cabin = Material(Pattern.CAR_CABIN, (lacquer, _GLASS, _GLASS), reflectivity=0.5)
    tyre = Material(Pattern.TYRE, (_DARK, (172, 176, 180), (90, 92, 96)), reflectivity=0.25)
    shapes = [
        _stationary(ShapeKind.BOX, (length / 2, width / 2, (waist - 0.22) / 2), (0, 0, 0.22), body),
        _stationary(
            ShapeKind.BOX,
            (0.28 * length, 0.46 * width, (height - waist) / 2),
            (-0.06 * length, 0, waist),
            cabin,
        ),
    ]
    wheels = [
        Shape(ShapeKind.CYLINDER, _lying(x, y, 0.32), (0.32, 0.32, 0.11), tyre)
        for x in (0.31 * length, -0.31 * length)
        for y in (width / 2 - 0.09, 0.09 - width / 2)
    ]
    return Design("car", (*shapes, *wheels), (length, width + 0.04, height))


def design_tree(generator: np.random.Generator) -> Design:
    """A trunk and a crown of two overlapping balls of leaves."""
    radius, crown, foot = (
        generator.uniform(0.12, 0.2),
        generator.uniform(1.2, 1.7),
        generator.uniform(2.2, 2.8),
    )
    bark = Material(Pattern.BARK, ((96, 76, 58), (64, 52, 42), (64, 52, 42)), reflectivity=0.4)
    colors = _LEAVES[int(generator.integers(len(_LEAVES)))]
    leaves = Material(Pattern.FOLIAGE, colors, reflectivity=0.55)
    rise = crown * generator.uniform(0.95, 1.35)
    shapes = (
        _stationary(ShapeKind.CYLINDER, (radius, radius, foot / 2 + 0.4), (0, 0, 0), bark),
        _stationary(ShapeKind.ELLIPSOID, (crown, crown, rise), (0, 0, foot), leaves),
        _stationary(
            ShapeKind.ELLIPSOID,
            (0.7 * crown, 0.7 * crown, 0.6 * rise),
            (0.25 * crown, -0.1, foot + 1.1 * rise),
            leaves,
        ),
    )
    return Design("tree", shapes, (2 * crown, 2 * crown, foot + 2.3 * rise), plan_lw=(2.0, 2.0))


def design_lamp(generator: np.random.Generator) -> Design:
    """A street lamp with its arm forwards."""
    height = generator.uniform(5.4, 6.2)
    steel = Material(Pattern.BANDS, (_STEEL, _tinted(_STEEL, 0.78), _STEEL), (1.0, 0.0, 0.0), 0.6)
    lamp = Material(Pattern.PLAIN, ((250, 246, 224),) * 3, reflectivity=0.8)
    shapes = (
        _stationary(ShapeKind.CYLINDER, (0.08, 0.08, height / 2), (0, 0, 0), steel),
        _stationary(ShapeKind.BOX, (0.7, 0.04, 0.04), (0.62, 0, height - 0.1), steel),
        _stationary(ShapeKind.BOX, (0.28, 0.11, 0.05), (1.35, 0, height - 0.2), lamp),
    )
    return Design("pole", shapes, (1.71, 0.22, height), ahead=0.775, plan_lw=(0.16, 0.16))


def design_sign(generator: np.random.Generator) -> Design:
    """A traffic sign that faces along its forward axis."""
    steel = Material(Pattern.PLAIN, (_STEEL,) * 3, reflectivity=0.6)
    color = _pick(generator, ((200, 36, 36), (30, 84, 170), (232, 190, 40)))
    face = Material(Pattern.BANDS, (color, _WHITE, color), (0.44, 0.0, 0.0), 1.0)
    shapes = (
        _stationary(ShapeKind.CYLINDER, (0.04, 0.04, 1.2), (0, 0, 0), steel),
        _stationary(ShapeKind.BOX, (0.02, 0.33, 0.33), (0.06, 0, 1.85), face),
    )
    return Design("pole", shapes, (0.16, 0.66, 2.51))


def design_bin(generator: np.random.Generator) -> Design:
    """A round waste bin with a lid."""
    color, radius = _pick(generator, _BIN_COLORS), generator.uniform(0.24, 0.3)
    body = Material(Pattern.BANDS, (color, _tinted(color, 1.35), color), (0.4, 0.0, 0.0), 0.5)
    lid = Material(Pattern.PLAIN, (_DARK,) * 3, reflectivity=0.3)
    shapes = (
        _stationary(ShapeKind.CYLINDER, (radius, radius, 0.45), (0, 0, 0), body),
        _stationary(ShapeKind.CYLINDER, (radius + 0.02, radius + 0.02, 0.04), (0, 0, 0.9), lid),
    )
    return Design("bin", shapes, (2 * radius + 0.04, 2 * radius + 0.04, 0.98))


def design_hedge(generator: np.random.Generator, *, length: float) -> Design:
    """A cut hedge, or a low wall of stones."""
    height = generator.uniform(0.9, 1.3)
    leaves = Material(Pattern.FOLIAGE, _LEAVES[int(generator.integers(2))], reflectivity=0.55)
    stones = Material(Pattern.BRICK, ((170, 150, 132), (206, 200, 190), _WHITE), reflectivity=0.6)
    material = leaves if generator.uniform() < 0.65 else stones
    shape = _stationary(ShapeKind.BOX, (length / 2, 0.25, height / 2), (0, 0, 0), material)
    return Design("barrier", (shape,), (length, 0.5, height))
