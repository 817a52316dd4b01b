"""What the sensors see around the ego, ahead up: where cameras look, and how far lidars and radars reach."""

import math

from sceneloom.pictures.depth_scale import COARSE_DIGITS, round_up
from sceneloom.report.drawings.axes import tick_text
from sceneloom.report.drawings.svg import Svg, series
from sceneloom.report.numbers.surroundings import CameraView, Coverage

SIZE = 360.0
_RADIUS = 152.0
_LEAST_REACH = 10.0


def draw_around(coverage: Coverage) -> Svg | None:
    """Draw the surroundings; None where no sensor's place is known."""
    clouds = [cloud for cloud in coverage.clouds if any(cloud.reaches)]
    cameras = [camera for camera in coverage.cameras if camera.left_deg is not None]
    if not clouds and not cameras:
        return None
    far = max([max(cloud.reaches) for cloud in clouds], default=50.0)
    reach = round_up(max(far, _LEAST_REACH), COARSE_DIGITS)
    svg = Svg(SIZE, SIZE)
    middle = SIZE / 2
    for share in (0.25, 0.5, 0.75, 1.0):
        svg.path(_arc(middle, _RADIUS * share, 0.0, 360.0), "grid hollow", closed=True)
        svg.text(middle + 4, middle - _RADIUS * share - 3, f"{tick_text(reach * share)} m", "faint")
    svg.line(middle, middle - _RADIUS, middle, middle + _RADIUS, "grid")
    svg.line(middle - _RADIUS, middle, middle + _RADIUS, middle, "grid")
    for k, camera in enumerate(cameras):
        _wedge(svg, camera, series(len(clouds) + k), middle)
    for k, cloud in enumerate(clouds):
        step = 360.0 / len(cloud.reaches)
        outline: list[tuple[float, float]] = []
        for sector, length in enumerate(cloud.reaches):
            radius = _RADIUS * min(length / reach, 1.0)
            outline += _arc(middle, radius, sector * step, (sector + 1) * step, corners=2)
        svg.path(
            outline, f"line hollow {series(k)}", closed=True, title=f"{cloud.sensor}: 95 % of its points"
        )
    svg.path(
        [(middle, middle - 10), (middle + 6, middle + 7), (middle, middle + 3), (middle - 6, middle + 7)],
        "fill ink-fill",
        closed=True,
    )
    svg.text(middle, 14, "ahead", "strong", anchor="middle")
    return svg


def named_shapes(coverage: Coverage) -> list[tuple[str, str]]:
    """The looks of the outlines and wedges, each with its name."""
    clouds = [f"{cloud.sensor} ({cloud.type})" for cloud in coverage.clouds if any(cloud.reaches)]
    cameras = [
        f"{camera.sensor}, {camera.across_deg or 0.0:.0f}° across"
        for camera in coverage.cameras
        if camera.left_deg is not None
    ]
    return [(series(k), name) for k, name in enumerate([*clouds, *cameras])]


def _wedge(svg: Svg, camera: CameraView, look: str, middle: float) -> None:
    if camera.left_deg is None or camera.right_deg is None:
        return
    arc = _arc(middle, _RADIUS, camera.right_deg, camera.left_deg)
    told = f"{camera.sensor}: from {camera.left_deg:.0f}° to {camera.right_deg:.0f}°, left is positive"
    svg.path([(middle, middle), *arc], f"wedge {look}", closed=True, title=told)


def _arc(
    middle: float, radius: float, start_deg: float, stop_deg: float, *, corners: int = 0
) -> list[tuple[float, float]]:
    """Corners along an arc, counter-clockwise from straight up, drawn finely unless so many corners are said."""
    count = corners or max(2, round(abs(stop_deg - start_deg) / 4) + 1)
    angles = [math.radians(start_deg + (stop_deg - start_deg) * k / (count - 1)) for k in range(count)]
    return [(middle - radius * math.sin(a), middle - radius * math.cos(a)) for a in angles]
