"""The camera of one model that comes nearest to a camera of another, and by how many pixels it differs."""

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, read_only
from sceneloom.cameras.camera import MODELS, Camera, Chart
from sceneloom.cameras.projection import check_camera, project_beyond_domain, project_unbounded, unproject
from sceneloom.errors import CalibrationError, OptionError

PERSPECTIVE_REACH = math.radians(80.0)
"""How far off its axis a model that ends at 90 degrees is fitted: there it magnifies 33 times already."""

_PERSPECTIVE_COSINE = math.cos(PERSPECTIVE_REACH)
_LOCATIONS = ("fx", "fy", "cx", "cy")
_FITTED_GRID, _MEASURED_GRID = (33, 25), (97, 73)
_NEAR_AXIS = 1e-4
_ENOUGH = 1e-6  # the share of the sum of squares below which a step gains nothing

_PRICE = 200.0
"""A fit that gives up half a percent of the image, where a polynomial folds, must be twice as good in the rest."""

_EQUALLY_GOOD_PX = 1e-9
_STAGES = (0, 1, 2, 4, 5, 8, 10, 100)  # how many coefficients are free in each stage, in the model's order

_FACTORS = tuple(f"{letter}{number}" for letter in "ij" for number in range(1, 5))
_SHIFT = "xi"
_STARTS: Mapping[str, float] = MappingProxyType({_SHIFT: 1.0, **dict.fromkeys(_FACTORS, 1.0)})
"""Coefficients that begin at another value than 0: a sphere of that shift sees behind the camera, and a factor of
others, all of them 0, would never leave it."""

_IN_PIXELS, _OFFSET = "ftheta", "k1"
"""The model whose coefficients hold the focal length, and the one of them that would part the middle of its image."""


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A camera model that stands in for another one, and how well.

    Attributes:
        camera: the camera model.
        largest_px: how far apart the two camera models put what the image shows, at most [px].
        rms_px: the root of the mean square of that distance [px].
        share: which part of what the exact camera model sees in its image the other one can hold, 0 to 1; distances are
            those of this part.
        unheld_pixels: (K, 2) float64 [px], those of a grid over the image that it cannot hold, such as those that
            look behind the camera under a perspective model.
    """

    camera: Camera
    largest_px: float
    rms_px: float
    share: float
    unheld_pixels: Float64Array

    def message(self, exact: Camera) -> str:
        """Report in words how well the camera model stands in for the exact one."""
        missing = 100.0 * (1.0 - self.share)
        beyond = f", and {missing:.2g} % of the image cannot be held" if self.share < 1 else ""
        return (
            f"{exact.model} camera model reported as {self.camera.model}, off by up to {self.largest_px:.2g} px, "
            f"{self.rms_px:.2g} px in the mean square{beyond}"
        )


def fit(camera: Camera, model: str, *, fixed: Collection[str] = ()) -> Fit:
    """Find the camera model of a model that puts what the image shows nearest to where the exact camera model puts it.

    The sum of squared distances over a grid of the image's pixels is minimised by the Levenberg-Marquardt method,
    from the focal length that the camera model has on its axis; coefficients are set free group by group.

    Args:
        camera: the exact camera model.
        model: a name out of `MODELS`.
        fixed: numbers that stay: of "fx", "fy", "cx", "cy" as the exact camera model has them; coefficients stay 0.

    Raises:
        CalibrationError: a model is unknown, or the exact camera model sees nothing of its image that the model could
            hold.
        OptionError: the model has no number of a name in `fixed`.
    """
    check_camera(camera)
    plain = Camera(model, camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    check_camera(plain)
    search = _Search.of(camera, plain, frozenset(fixed))
    return _best([measured_fit(camera, found) for found in search.candidates()])


def nearest(camera: Camera, models: Mapping[str, Collection[str]]) -> Fit:
    """Find the camera model that comes nearest out of several models.

    Args:
        camera: the exact camera model.
        models: names out of `MODELS`, each with its `fixed` numbers as in `fit`; of equally good ones the first wins.

    Raises:
        CalibrationError: a model is unknown, or none holds anything of what the exact camera model sees.
    """
    fits, refusals = list[Fit](), list[CalibrationError]()
    for model, fixed in models.items():
        try:
            fits.append(fit(camera, model, fixed=fixed))
        except CalibrationError as error:
            refusals.append(error)
    if not fits:
        raise refusals[0]
    return _best(fits)


def _best(fits: list[Fit]) -> Fit:
    most = max(one.share for one in fits)
    return min(fits, key=lambda one: max(one.rms_px, _EQUALLY_GOOD_PX) * (1.0 + _PRICE * (most - one.share)))


def measured_fit(exact: Camera, other: Camera) -> Fit:
    """Measure how well a camera model stands in for another, as it is.

    Raises:
        CalibrationError: a model is unknown, or the exact camera model sees nothing of its image.
    """
    pixels, rays = _seen_grid(exact, _MEASURED_GRID)
    off = np.hypot(*(project_unbounded(other, rays) - pixels).T)
    held = np.isfinite(off)
    if _is_perspective(other):
        held &= rays[:, 2] > _PERSPECTIVE_COSINE
    off = off[held]
    largest, rms = (float(off.max()), float(np.sqrt(np.mean(off * off)))) if len(off) else (math.inf, math.inf)
    return Fit(other, largest, rms, float(held.mean()), read_only(pixels[~held]))


def _seen_grid(camera: Camera, size: tuple[int, int]) -> tuple[Float64Array, Float64Array]:
    """Pixels all over the image, its edges included, and the rays along which they look; only those that do."""
    columns = np.linspace(-0.5, camera.width - 0.5, size[0])
    rows = np.linspace(-0.5, camera.height - 0.5, size[1])
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    rays = unproject(camera, pixels)
    seen = np.isfinite(rays).all(axis=1)
    if not seen.any():
        raise CalibrationError(f"{camera.model} camera model: no pixel of its image looks anywhere; is it folded?")
    return pixels[seen], rays[seen]


def _is_perspective(camera: Camera) -> bool:
    """Whether a camera model ends at 90 degrees off its axis, whatever its coefficients are."""
    return MODELS[camera.model].chart is Chart.PERSPECTIVE


@dataclass(frozen=True, slots=True, eq=False)
class _Search:
    """What is searched for."""

    exact: Camera  # the camera model to be replaced
    model: str  # of the one that replaces it
    fixed: frozenset[str]  # names of numbers that stay
    pixels: Float64Array  # (N, 2) of the exact camera model
    rays: Float64Array  # (N, 3) along which it looks there

    @classmethod
    def of(cls, exact: Camera, plain: Camera, fixed: frozenset[str]) -> "_Search":
        names = (*_LOCATIONS, *MODELS[plain.model].coefficient_names)
        unknown = sorted(fixed.difference(names))
        if unknown:
            raise OptionError(f"fixed {unknown[0]!r}; {plain.model} has {', '.join(names)}")
        pixels, rays = _seen_grid(exact, _FITTED_GRID)
        fixed |= {_OFFSET} if plain.model == _IN_PIXELS else set()
        search = cls(exact, plain.model, fixed, pixels, rays)
        usable = np.isfinite(search.project(search.start())).all(axis=1)
        if _is_perspective(plain):
            usable &= rays[:, 2] > _PERSPECTIVE_COSINE
        if not usable.any():
            raise CalibrationError(
                f"{plain.model} holds nothing of what the {exact.model} camera model sees; choose another model"
            )
        return cls(exact, plain.model, fixed, pixels[usable], rays[usable])

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all numbers of the camera model."""
        return (*_LOCATIONS, *MODELS[self.model].coefficient_names)

    def project(self, numbers: Float64Array) -> Float64Array:
        """Where the camera model of these numbers puts the rays."""
        return project_beyond_domain(self.model, numbers, self.rays)

    def camera(self, numbers: Float64Array) -> Camera:
        """The camera model of these numbers."""
        fx, fy, cx, cy, *coefficients = map(float, numbers)
        return Camera(self.model, self.exact.width, self.exact.height, fx, fy, cx, cy, tuple(coefficients))

    def start(self) -> Float64Array:
        """A camera model without distortion that magnifies on its axis as the exact one does."""
        exact = self.exact
        coefficients = [0.0 if name in self.fixed else _STARTS.get(name, 0.0) for name in self.names[4:]]
        numbers = np.array([exact.fx, exact.fy, exact.cx, exact.cy, *coefficients])
        wanted = _slopes_on_axis(lambda rays: project_unbounded(exact, rays))
        if self.model == _IN_PIXELS:
            numbers[self.names.index("k2")] = wanted.mean()
            return numbers
        found = _slopes_on_axis(lambda rays: project_beyond_domain(self.model, numbers, rays))
        for k, name in enumerate(("fx", "fy")):
            ratio = wanted[k] / found[k] if found[k] else math.nan
            if name not in self.fixed and 0 < ratio < math.inf:
                numbers[k] *= ratio
        return numbers

    def same_names(self) -> Float64Array:
        """A camera model with the coefficients of the exact one, as far as the model has some of those names."""
        exact = self.exact
        known = dict(zip(MODELS[exact.model].coefficient_names, exact.coefficients, strict=False))
        coefficients = [0.0 if name in self.fixed else known.get(name, 0.0) for name in self.names[4:]]
        return np.array([exact.fx, exact.fy, exact.cx, exact.cy, *coefficients])

    def unshifted(self) -> Float64Array | None:
        """The start of a model with a shifted sphere without that shift, which is a perspective camera model."""
        # None where the model has no shift to be found, or a perspective camera model does not see as far
        perspective = (self.rays[:, 2] > _PERSPECTIVE_COSINE).all()
        if _SHIFT not in self.names or _SHIFT in self.fixed or not perspective:
            return None
        plain, location = self.start(), self.names.index(_SHIFT)
        plain[:2] /= 1.0 + plain[location]
        plain[location] = 0.0
        return plain

    def candidates(self) -> list[Camera]:
        """The camera model after each group of numbers that was set free, and that from coefficients of equal names."""
        stages, found = self._stages(), list[Float64Array]()
        numbers, unshifted = self.start(), self.unshifted()
        for free in stages:
            numbers = self._fitted(numbers, free)
            found.append(numbers)
        if unshifted is not None:
            still = np.array([name != _SHIFT for name in self.names])
            for free in (*(one & still for one in stages), stages[-1]):
                unshifted = self._fitted(unshifted, free)
                found.append(unshifted)
        if self.model == self.exact.model:
            found.append(self._fitted(self.same_names(), stages[-1]))
        return [self.camera(one) for one in found if one[0] > 0 and one[1] > 0]

    def _stages(self) -> list[BoolArray]:
        """Which numbers are free, stage by stage; a model names its coefficients by how common they are."""
        names = self.names
        always = {*_LOCATIONS, *_STARTS}
        groups = [always | set(names[4 : 4 + count]) for count in _STAGES]
        free = [np.array([n in group and n not in self.fixed for n in names]) for group in groups]
        return [one for k, one in enumerate(free) if k == 0 or (one != free[k - 1]).any()]

    def _fitted(self, numbers: Float64Array, free: BoolArray) -> Float64Array:
        from scipy.optimize import least_squares

        def residuals(values: Float64Array) -> Float64Array:
            trial = numbers.copy()
            trial[free] = values
            off: Float64Array = (self.project(trial) - self.pixels).ravel()
            return off

        if not free.any():
            return numbers
        least = least_squares(
            residuals,
            numbers[free],
            jac="3-point",
            # MINPACK asks for as many residuals as values
            method="lm" if self.pixels.size >= free.sum() else "trf",
            x_scale="jac",
            ftol=_ENOUGH,
            xtol=_ENOUGH**2,
        )
        found = numbers.copy()
        if np.isfinite(least.x).all():
            found[free] = least.x
        return found


def _slopes_on_axis(project: Callable[[Float64Array], Float64Array]) -> Float64Array:
    """How many pixels a camera model moves what moves by one radian, near its axis: to the right, and down."""
    sin, cos = math.sin(_NEAR_AXIS), math.cos(_NEAR_AXIS)
    right, left, down, up = project(np.array([[sin, 0.0, cos], [-sin, 0.0, cos], [0.0, sin, cos], [0.0, -sin, cos]]))
    return np.array([right[0] - left[0], down[1] - up[1]]) / (2.0 * _NEAR_AXIS)
