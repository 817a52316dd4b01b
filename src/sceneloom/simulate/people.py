"""Who moves along the street: people on foot and on bicycles, and cars, in frames of their own as movers have them."""

from collections.abc import Sequence

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.simulate.movers import MovingDesign, Part
from sceneloom.simulate.objects import design_car
from sceneloom.simulate.path import rotation_from_angles
from sceneloom.simulate.shapes import Color, Material, Pattern, Shape, ShapeKind

Point = tuple[float, float, float]

_CLOTHES: tuple[Color, ...] = (
    (178, 42, 46), (38, 72, 140), (228, 226, 220), (46, 48, 54), (52, 118, 82), (226, 178, 62), (120, 66, 126),
    (214, 110, 52), (92, 148, 180), (150, 132, 108),
)  # fmt: skip
_TROUSERS: tuple[Color, ...] = ((44, 54, 84), (40, 40, 44), (110, 98, 80), (76, 82, 90))
_SKIN: tuple[Color, ...] = ((232, 190, 160), (198, 150, 116), (140, 98, 72), (92, 64, 48))
_HAIR: tuple[Color, ...] = ((48, 36, 28), (28, 26, 26), (150, 116, 70), (120, 60, 36), (176, 174, 170))
_HELMETS: tuple[Color, ...] = ((236, 236, 232), (200, 40, 40), (40, 44, 52), (240, 190, 40))
_FRAMES: tuple[Color, ...] = ((180, 36, 40), (36, 76, 150), (40, 44, 48), (60, 130, 90), (222, 222, 218))
_SHOES: Color = (42, 38, 36)

_STEP = 0.3
"""How far a walker's leg swings to either side [rad]."""


def design_pedestrian(generator: np.random.Generator, *, walks: bool = True) -> MovingDesign:
    """Someone on foot: legs that swing where they walk, trunk, arms, head."""
    height = generator.uniform(1.55, 1.92)
    hip = 0.5 * height
    coat, trousers = _cloth(generator, _CLOTHES), _cloth(generator, _TROUSERS)
    skin, hair = _cloth(generator, _SKIN), _cloth(generator, _HAIR)
    body = [
        _upright(ShapeKind.CYLINDER, (0, 0, 0.655 * height), (0.115, 0.165, 0.175 * height), coat),
        _upright(ShapeKind.ELLIPSOID, (0, 0, 0.8 * height), (0.115, 0.215, 0.06 * height), coat),
        _limb((0, 0, 0.8 * height), (0.01, 0, 0.9 * height), 0.055, skin),
        _upright(ShapeKind.ELLIPSOID, (0.015, 0, height - 0.125), (0.1, 0.078, 0.12), skin),
        _upright(ShapeKind.ELLIPSOID, (-0.012, 0, height - 0.09), (0.102, 0.088, 0.09), hair),
    ]
    for side in (-1.0, 1.0):
        body.append(_limb((0, 0.205 * side, 0.8 * height), (0.0, 0.235 * side, 0.6 * height), 0.05, coat))
        body.append(_limb((0, 0.235 * side, 0.6 * height), (0.07, 0.235 * side, 0.45 * height), 0.038, skin))
    legs = [
        Part(_leg(0.09 * side, hip, trousers), (0, 0.09 * side, hip), _STEP if walks else 0.0, lead)
        for side, lead in ((1.0, 0.0), (-1.0, np.pi))
    ]
    return _designed("pedestrian", (Part(tuple(body)), *legs))


def design_cyclist(generator: np.random.Generator) -> MovingDesign:
    """Someone on a bicycle: two wheels, a frame and its rider."""
    coat, trousers = _cloth(generator, _CLOTHES), _cloth(generator, _TROUSERS)
    skin, helmet, steel = (_cloth(generator, choice) for choice in (_SKIN, _HELMETS, _FRAMES))
    tyre = Material(Pattern.TYRE, ((34, 34, 36), (150, 154, 158), (96, 98, 102)), reflectivity=0.25)
    lying = rotation_from_angles(np.array(np.pi / 2), np.zeros(()), np.zeros(()))
    shapes = [
        Shape(ShapeKind.CYLINDER, RigidTransform(lying, np.array([x, 0.0, 0.34])), (0.34, 0.34, 0.02), tyre)
        for x in (-0.52, 0.52)
    ]
    pedals, seat, head = (-0.02, 0.0, 0.3), (-0.18, 0.0, 0.95), (0.37, 0.0, 0.9)
    tubes = [
        (pedals, seat), (pedals, (0.38, 0.0, 0.76)), ((-0.14, 0.0, 0.8), head), (pedals, (-0.52, 0.0, 0.34)),
        ((-0.14, 0.0, 0.8), (-0.52, 0.0, 0.34)), ((0.35, 0.0, 1.0), (0.52, 0.0, 0.34)),
        ((0.36, -0.26, 1.02), (0.36, 0.26, 1.02)),
    ]  # fmt: skip
    shapes += [_limb(start, end, 0.022, steel) for start, end in tubes]
    for side, knee, foot in ((1.0, (0.2, 0.7), (0.03, 0.2)), (-1.0, (0.25, 0.86), (0.06, 0.44))):
        at_knee, at_foot = (knee[0], 0.11 * side, knee[1]), (foot[0], 0.11 * side, foot[1])
        shapes.append(_limb((-0.16, 0.1 * side, 1.0), at_knee, 0.078, trousers))
        shapes.append(_limb(at_knee, at_foot, 0.058, trousers))
        shapes.append(_limb((0.11, 0.19 * side, 1.42), (0.34, 0.24 * side, 1.06), 0.045, coat))
    shapes += [
        _limb((-0.17, 0, 0.96), (0.1, 0, 1.46), 0.145, coat),
        _upright(ShapeKind.ELLIPSOID, (0.1, 0, 1.44), (0.12, 0.215, 0.11), coat),
        _limb((0.1, 0, 1.45), (0.17, 0, 1.6), 0.055, skin),
        _upright(ShapeKind.ELLIPSOID, (0.19, 0, 1.66), (0.1, 0.078, 0.12), skin),
        _upright(ShapeKind.ELLIPSOID, (0.17, 0, 1.71), (0.135, 0.098, 0.085), helmet),
    ]
    return _designed("cyclist", (Part(tuple(shapes)),))


def design_moving_car(generator: np.random.Generator) -> MovingDesign:
    """A car as those that are parked."""
    design = design_car(generator)
    return MovingDesign("car", (Part(design.shapes),), design.size_lwh)


def _leg(left: float, hip: float, cloth: Material) -> tuple[Shape, ...]:
    shoe = Material(Pattern.PLAIN, (_SHOES,) * 3, reflectivity=0.3)
    return (
        _limb((0, left, hip), (0, left, 0.5 * hip), 0.085, cloth),
        _limb((0, left, 0.55 * hip), (0, left, 0.06), 0.066, cloth),
        _upright(ShapeKind.BOX, (0.03, left, 0.045), (0.12, 0.048, 0.045), shoe),
    )


def _cloth(generator: np.random.Generator, choices: Sequence[Color]) -> Material:
    color = choices[int(generator.integers(len(choices)))]
    return Material(Pattern.PLAIN, (color,) * 3, reflectivity=0.55)


def _upright(kind: ShapeKind, center: Point, half: Point, material: Material) -> Shape:
    return Shape(kind, RigidTransform(np.eye(3), np.array(center, np.float64)), half, material)


def _limb(start: Point, end: Point, radius: float, material: Material) -> Shape:
    """A cylinder from one point to another."""
    a, b = np.array(start, np.float64), np.array(end, np.float64)
    length = float(np.linalg.norm(b - a))
    axis = (b - a) / length
    beside = np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[0]) < 0.9 else [0.0, 1.0, 0.0])
    beside /= np.linalg.norm(beside)
    rotation = np.column_stack([beside, np.cross(axis, beside), axis])
    return Shape(
        ShapeKind.CYLINDER, RigidTransform(rotation, (a + b) / 2), (radius, radius, length / 2), material
    )


def _designed(label: str, parts: tuple[Part, ...]) -> MovingDesign:
    """Put the box around all that parts do: symmetric about the origin, from the ground up."""
    reach = np.zeros(3)
    for part in parts:
        rotations = np.array([shape.pose.rotation for shape in part.shapes])
        centers = np.array([shape.pose.translation for shape in part.shapes]) - part.hinge
        for angle in np.linspace(-part.swing, part.swing, 9 if part.swing else 1):
            delta_rotation = rotation_from_angles(np.zeros(()), np.array(-angle), np.zeros(()))
            locations = np.abs(centers @ delta_rotation.T + part.hinge)
            for shape, rotation, location in zip(
                part.shapes, delta_rotation @ rotations, locations, strict=True
            ):
                reach = np.maximum(reach, location + _half_extents(shape, rotation))
    return MovingDesign(label, parts, (float(2 * reach[0]), float(2 * reach[1]), float(reach[2])))


def _half_extents(shape: Shape, rotation: Float64Array) -> Float64Array:
    """How far a rotated shape reaches from its middle along x, y and z [m], (3,)."""
    arms = np.abs(rotation) * np.array(shape.half)
    if shape.kind is ShapeKind.ELLIPSOID:
        return np.asarray(np.linalg.norm(arms, axis=1), np.float64)
    if shape.kind is ShapeKind.CYLINDER:
        return np.asarray(np.hypot(arms[:, 0], arms[:, 1]) + arms[:, 2], np.float64)
    return np.asarray(arms.sum(axis=1), np.float64)
