"""Parts that distortions share: radial polynomials in s, the distance squared, and decentring and prism terms."""

from numba import njit

from sceneloom.cameras.compiled import INLINE


@njit(**INLINE)
def stretch(a, b, g, g_s):  # type: ignore[no-untyped-def]
    """Stretch (a, b) by the factor g(s), s = a² + b², whose slope is g_s: location and slopes as of `distort`."""
    mixed = 2.0 * a * b * g_s
    return a * g, b * g, g + 2.0 * a * a * g_s, mixed, mixed, g + 2.0 * b * b * g_s


@njit(**INLINE)
def decentre(a, b, s, g, g_s, p1, p2):  # type: ignore[no-untyped-def]
    """Stretch (a, b) by g(s) and add the terms of a decentred camera model, for any s: location and partial slopes.

    x = a g + 2 p1 a b + p2 (s + 2 a²),  y = b g + p1 (s + 2 b²) + 2 p2 a b

    Returns:
        x, y; the slopes over a and b with s held: xa, xb, ya, yb; the slopes over s: xs, ys.

    Source: OpenCV documentation, "Camera Calibration and 3D Reconstruction", detailed description.
    """
    mixed = 2.0 * a * b
    return (
        a * g + p1 * mixed + p2 * (s + 2.0 * a * a),
        b * g + p1 * (s + 2.0 * b * b) + p2 * mixed,
        g + 2.0 * p1 * b + 4.0 * p2 * a,
        2.0 * p1 * a,
        2.0 * p2 * b,
        g + 4.0 * p1 * b + 2.0 * p2 * a,
        a * g_s + p2,
        b * g_s + p1,
    )


@njit(**INLINE)
def shift_and_decentre(x, y, g, g_s, lx, ly, p1, p2):  # type: ignore[no-untyped-def]
    """Decentre (x + lx, y + ly) with s = x² + y² of the location before the shift.

    Location and slopes as of `distort`.
    """
    to_x, to_y, xa, xb, ya, yb, xs, ys = decentre(x + lx, y + ly, x * x + y * y, g, g_s, p1, p2)
    return to_x, to_y, xa + 2.0 * x * xs, xb + 2.0 * y * xs, ya + 2.0 * x * ys, yb + 2.0 * y * ys


@njit(**INLINE)
def bend_image(stretched, p1, p2, s1, s2, s3, s4):  # type: ignore[no-untyped-def]
    """Add decentring and prism terms to a location that is already stretched: location and slopes as of `distort`.

    Args:
        stretched: what `stretch` gave.
        p1, p2: OpenCV's decentring.
        s1, s2, s3, s4: x gains s1 r² + s2 r⁴, y gains s3 r² + s4 r⁴, r the distance of the stretched location.
    """
    x, y, xx, xy, yx, yy = stretched
    s = x * x + y * y
    to_x, to_y, xa, xb, ya, yb, xs, ys = decentre(x, y, s, 1.0, 0.0, p1, p2)
    xs, ys = xs + s1 + 2.0 * s2 * s, ys + s3 + 2.0 * s4 * s
    xa, xb, ya, yb = xa + 2.0 * x * xs, xb + 2.0 * y * xs, ya + 2.0 * x * ys, yb + 2.0 * y * ys
    return (
        to_x + s * (s1 + s * s2),
        to_y + s * (s3 + s * s4),
        xa * xx + xb * yx,
        xa * xy + xb * yy,
        ya * xx + yb * yx,
        ya * xy + yb * yy,
    )
