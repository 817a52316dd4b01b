"""Tests of eight neighbouring cells at once, by vector instructions.

The compiler finds no vectors in loops over so few cells, each with several conditions; here they are written down.
What a processor has not, the compiler takes apart.
"""

from typing import Any

from llvmlite import ir
from numba import extending, types
from numba.np import arrayobj

LANES = 8
"""Cells that are tested at once. They lie side by side; so many must exist from the first one on."""

_intrinsic: Any = extending.intrinsic
_make_array: Any = arrayobj.make_array

_VECTOR, _WORD = ir.VectorType(ir.FloatType(), LANES), ir.IntType(32)
_STEPS, _ZERO, _ONE = (ir.Constant(_VECTOR, values) for values in ([*range(LANES)], [0] * LANES, [1] * LANES))


def _spread(builder: Any, value: Any) -> Any:
    """Put one number into all lanes."""
    alone = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), value, ir.Constant(_WORD, 0))
    everywhere = ir.Constant(ir.VectorType(_WORD, LANES), [0] * LANES)
    return builder.shuffle_vector(alone, ir.Constant(_VECTOR, ir.Undefined), everywhere)


def _load(context: Any, builder: Any, array_type: Any, array: Any, first: Any) -> Any:
    """Read as many numbers of a float32 array as there are lanes."""
    place = builder.gep(_make_array(array_type)(context, builder, array).data, [first])
    return builder.load(builder.bitcast(place, _VECTOR.as_pointer()), align=4)


def _square(builder: Any, x: Any, y: Any) -> Any:
    return builder.fadd(builder.fmul(x, x), builder.fmul(y, y))


def _all(builder: Any, *tests: Any) -> Any:
    passed = tests[0]
    for test in tests[1:]:
        passed = builder.and_(passed, test)
    return passed


def _hides(builder: Any, nearest: Any, squared: Any, threshold: Any, slope_squared: Any) -> Any:
    """Which lanes are nearer by an excess that no surface gains over so short a distance."""
    excess = builder.fsub(nearest, threshold)
    gained = builder.fmul(slope_squared, squared)
    above = builder.fcmp_ordered(">", builder.fmul(excess, excess), gained)
    return _all(builder, builder.fcmp_ordered(">", excess, _ZERO), above)


def _in_ellipse(builder: Any, x: Any, y: Any, p: Any, q: Any, r: Any) -> Any:
    form = builder.fmul(p, builder.fmul(x, x))
    form = builder.fadd(form, builder.fmul(q, builder.fmul(x, y)))
    form = builder.fadd(form, builder.fmul(r, builder.fmul(y, y)))
    return builder.fcmp_ordered("<=", form, _ONE)


def _as_bits(builder: Any, lanes: Any) -> Any:
    return builder.zext(builder.bitcast(lanes, ir.IntType(LANES)), ir.IntType(64))


def _places(context: Any, builder: Any, signature: Any, args: Any) -> tuple[Any, Any, Any, list[Any]]:
    """Read what the cells hold: how near, and where as seen from a point; and spread the numbers behind."""
    nearest, right, down = (_load(context, builder, signature.args[i], args[i], args[3]) for i in range(3))
    numbers = (builder.extract_value(args[4], i) for i in range(len(signature.args[4])))
    x_first, y_first, *others = (_spread(builder, number) for number in numbers)
    return nearest, builder.fadd(right, builder.fadd(x_first, _STEPS)), builder.fadd(down, y_first), others


@_intrinsic
def find_beside(_typing: Any, nearest: Any, right: Any, down: Any, first: Any, numbers: Any) -> Any:
    """Tell which of the cells from `first` on hide a point beside which they lie, one bit each.

    Args:
        nearest, right, down: float32 arrays, what the cells hold, as of `direction_grid`.
        first: uint64, the number of the first cell.
        numbers: float32:
            x, y: from the point to the corner of the first cell [cells],
            threshold: inverse range beyond which something is nearer than the point [1/m],
            slope_squared: square of what surfaces gain [1/m/cell],
            p, q, r: the ellipse p x² + q x y + r y² <= 1 around the point.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        inverse, x_to, y_to, (above, slope, *ellipse) = _places(context, builder, signature, args)
        inside = _in_ellipse(builder, x_to, y_to, *ellipse)
        hides = _hides(builder, inverse, _square(builder, x_to, y_to), above, slope)
        return _as_bits(builder, _all(builder, inside, hides))

    return types.uint64(nearest, right, down, first, numbers), generate


@_intrinsic
def find_nearing(_typing: Any, nearest: Any, right: Any, down: Any, first: Any, numbers: Any) -> Any:
    """Tell the same of cells whose point came nearer on the eye's way from the lidar to the camera.

    Args:
        nearest, right, down, first: as of `find_beside`.
        numbers: float32: those of `find_beside`, then
            inverse: the point's inverse range [1/m],
            shift_x, shift_y: how something shifts on that way [cells m], against what is infinitely far, for each of
            its inverse range,
            nearing: to what share of its distance something must have come.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        there, x_to, y_to, (above, slope, *numbers) = _places(context, builder, signature, args)
        *ellipse, own, right_shift, down_shift, share = numbers
        gained = builder.fsub(there, own)
        x_from = builder.fsub(x_to, builder.fmul(gained, right_shift))
        y_from = builder.fsub(y_to, builder.fmul(gained, down_shift))
        along = builder.fadd(builder.fmul(x_to, x_from), builder.fmul(y_to, y_from))
        limit = builder.fmul(share, _square(builder, x_from, y_from))
        came = builder.fcmp_ordered("<=", along, limit)
        inside = _in_ellipse(builder, x_to, y_to, *ellipse)
        hides = _hides(builder, there, _square(builder, x_to, y_to), above, slope)
        return _as_bits(builder, _all(builder, inside, hides, came))

    return types.uint64(nearest, right, down, first, numbers), generate


@_intrinsic
def find_quadrants(_typing: Any, nearest: Any, right: Any, down: Any, first: Any, numbers: Any) -> Any:
    """Tell in which quadrants around a point the cells from `first` on hold what hides it.

    Each quadrant holds one of its two borders, so that opposite steps fall into opposite quadrants.

    Args:
        nearest, right, down, first: as of `find_beside`.
        numbers: float32: the first four of `find_beside`, then
            window_squared: square of how far from the point the cells may be [cells²].

    Returns:
        The lanes of the first quadrant in the lowest bits, then those of the second, third and fourth.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        inverse, x_to, y_to, (above, slope, window) = _places(context, builder, signature, args)
        squared = _square(builder, x_to, y_to)
        hides = _hides(builder, inverse, squared, above, slope)
        hides = _all(builder, hides, builder.fcmp_ordered("<=", squared, window))
        # Both borders of each axis, then whole numbers: of vectors four comparisons are left.
        right_of, left_of, below, above_it = (
            _as_bits(builder, builder.fcmp_ordered(test, to, _ZERO))
            for test, to in ((">", x_to), ("<", x_to), (">", y_to), ("<", y_to))
        )
        there = _as_bits(builder, hides)
        bits = ir.Constant(ir.IntType(64), 0)
        for number, (holds, lacks) in enumerate(
            ((right_of, above_it), (below, right_of), (left_of, below), (above_it, left_of))
        ):
            found = builder.and_(builder.and_(there, holds), builder.not_(lacks))
            bits = builder.or_(bits, builder.shl(found, ir.Constant(ir.IntType(64), number * LANES)))
        return bits

    return types.uint64(nearest, right, down, first, numbers), generate
