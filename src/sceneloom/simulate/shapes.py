"""Convex shapes with a material, and many of them packed for the ray caster."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from enum import IntEnum

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, UInt8Array
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.kernels import raycast, textures

Color = tuple[float, float, float]
"""Red, green, blue in 0..255, as light of full strength would show them."""


class ShapeKind(IntEnum):
    """The unit bodies that the ray caster knows."""

    BOX = raycast.BOX
    CYLINDER = raycast.CYLINDER
    ELLIPSOID = raycast.ELLIPSOID
    GABLE = raycast.GABLE


class Pattern(IntEnum):
    """How a surface mixes the colours of its palette."""

    PLAIN = textures.PLAIN
    FACADE = textures.FACADE
    BRICK = textures.BRICK
    TILES = textures.TILES
    FOLIAGE = textures.FOLIAGE
    BARK = textures.BARK
    CAR_BODY = textures.CAR_BODY
    CAR_CABIN = textures.CAR_CABIN
    TYRE = textures.TYRE
    BANDS = textures.BANDS


@dataclass(frozen=True, slots=True)
class Material:
    """What a surface looks like to cameras and lidars.

    Attributes:
        pattern: how the colours are mixed.
        colors: the palette: first, second and third colour.
        measures: lengths of the pattern [m]: window pitch, storey height, strength of the bricks for a facade; the
            period for bands.
        reflectivity: share of laser light that comes back at square incidence from a white surface.
    """

    pattern: Pattern
    colors: tuple[Color, Color, Color]
    measures: tuple[float, float, float] = (1.0, 1.0, 0.0)
    reflectivity: float = 0.6


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """One convex body.

    Attributes:
        kind: which.
        pose: `parent_from_shape`.
        half: half sizes along the shape's own axes [m]; the cylinder's axis is z, the gable's ridge runs along x.
        material: its surface.
    """

    kind: ShapeKind
    pose: RigidTransform
    half: tuple[float, float, float]
    material: Material

    def moved(self, world_from_parent: RigidTransform) -> "Shape":
        """The same shape in another frame."""
        return replace(self, pose=world_from_parent @ self.pose)

    @property
    def radius(self) -> float:
        """Radius of a ball around the shape's centre that holds it [m]."""
        x, y, z = self.half
        if self.kind is ShapeKind.ELLIPSOID:
            return max(self.half)
        if self.kind is ShapeKind.CYLINDER:
            return float(np.hypot(max(x, y), z))
        return float(np.linalg.norm(self.half))


@dataclass(frozen=True, slots=True, eq=False)
class PackedShapes:
    """P shapes in the world as the kernels take them.

    Attributes:
        kinds: (P,) uint8.
        maps: (P, 3, 4) float64, world to the space of the unit body.
        spheres: (P, 4) float64 [m], centre and radius of a ball around each.
        halves: (P, 3) float64 [m].
        patterns: (P,) uint8.
        palettes: (P, 3, 3) float64.
        measures: (P, 3) float64.
        instances: (P,) int64, the object that a shape belongs to; also what its noise starts from.
        reflectivities: (P,) float64.
    """

    kinds: UInt8Array
    maps: Float64Array
    spheres: Float64Array
    halves: Float64Array
    patterns: UInt8Array
    palettes: Float64Array
    measures: Float64Array
    instances: Int64Array
    reflectivities: Float64Array

    @classmethod
    def of(cls, shapes: Sequence[Shape], instances: Sequence[int]) -> "PackedShapes":
        """Pack shapes given in the world frame, each with the id of its object."""
        rotations = np.array([shape.pose.rotation for shape in shapes]).reshape(-1, 3, 3)
        centers = np.array([shape.pose.translation for shape in shapes]).reshape(-1, 3)
        halves = np.array([shape.half for shape in shapes], np.float64).reshape(-1, 3)
        linear = rotations.transpose(0, 2, 1) / halves[:, :, None]
        offsets = -np.einsum("pij,pj->pi", linear, centers)
        radii = np.array([shape.radius for shape in shapes], np.float64)
        materials = [shape.material for shape in shapes]
        return cls(
            np.array([shape.kind for shape in shapes], np.uint8),
            np.ascontiguousarray(np.concatenate([linear, offsets[:, :, None]], axis=2)),
            np.column_stack([centers, radii]),
            halves,
            np.array([material.pattern for material in materials], np.uint8),
            np.array([material.colors for material in materials], np.float64).reshape(-1, 3, 3),
            np.array([material.measures for material in materials], np.float64).reshape(-1, 3),
            np.asarray(instances, np.int64).reshape(-1),
            np.array([material.reflectivity for material in materials], np.float64),
        )

    def __len__(self) -> int:
        return len(self.kinds)

    def joined(self, others: "PackedShapes") -> "PackedShapes":
        """These shapes, then others."""
        return PackedShapes(
            *(
                np.concatenate([getattr(self, part.name), getattr(others, part.name)])
                for part in fields(PackedShapes)
            )
        )
