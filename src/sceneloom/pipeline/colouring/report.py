"""What a colouring did, in numbers."""

from math import isfinite

import msgspec

from sceneloom.colouring.exposure import ExposureGains
from sceneloom.pipeline.fusing.report import CameraReport
from sceneloom.scene.types import Identifier
from sceneloom.scene.warnings import DataWarning


class ExposureReport(msgspec.Struct, frozen=True, kw_only=True):
    """How differently the cameras were exposed.

    Attributes:
        seam_before, seam_after: median difference [levels] of the colours of points that two cameras show at once;
            None where no two cameras do.
        seam_points: how many points that is of.
        alone: cameras that nothing links to another; they keep their mean brightness.
        unlinked: cameras whose images share nothing that can be compared; they keep their colours.
        factors: of each other camera, the least and the greatest factor of its images.
    """

    seam_before: float | None
    seam_after: float | None
    seam_points: int
    alone: tuple[Identifier, ...]
    unlinked: tuple[Identifier, ...]
    factors: dict[str, tuple[float, float]]

    @classmethod
    def of(cls, gains: ExposureGains, cameras: dict[int, Identifier]) -> "ExposureReport":
        """Report what was found, by the cameras' ids instead of their indices."""
        found = {camera: logs for camera, logs in gains.log_gains.items() if len(logs)}
        return cls(
            seam_before=gains.seam_before if isfinite(gains.seam_before) else None,
            seam_after=gains.seam_after if isfinite(gains.seam_after) else None,
            seam_points=gains.seam_pairs,
            alone=tuple(cameras[camera] for camera in gains.alone if camera in found),
            unlinked=tuple(cameras[camera] for camera in gains.alone if camera not in found),
            factors={
                str(cameras[camera]): (
                    float(2.718281828459045 ** logs.min()),
                    float(2.718281828459045 ** logs.max()),
                )
                for camera, logs in found.items()
            },
        )


class LabelReport(msgspec.Struct, frozen=True, kw_only=True):
    """What became of labels.

    Attributes:
        images: label images that were painted onto points.
        missing: images that no label image is of.
        points: points that got a label.
        drawn: label images that were made of labelled points.
        classes: how many different labels the points got, or the drawn images have.
    """

    images: int = 0
    missing: int = 0
    points: int = 0
    drawn: int = 0
    classes: int = 0


class ColourReport(msgspec.Struct, frozen=True, kw_only=True):
    """One colouring.

    Attributes:
        source: what was coloured.
        output: the map written, or None.
        trajectory: name of the ego trajectory that the map stands on, or None where the scene's own poses were used.
        blend: how the colours of several images became one.
        frames: sweeps that were read.
        fused: sweeps that are in the outputs.
        unfused: why the others are not, with counts.
        skipped: sweeps and images that could not be read, one line each.
        points: points of all fused sweeps.
        coloured_percent: share of them that got a colour.
        removed_in_boxes, removed_by_rays: points left out because they lie in boxes that move, and because rays of
            other sweeps pass through their locations.
        unjudged: sweeps of which it is not known from where they were measured, so that rays state nothing.
        written: points of the map.
        exposure: None where it was left as it is.
        labels: None where there are none.
        cameras: one report per camera.
        files: further files written, with counts by kind.
        seconds: how long it took.
        warnings: what was assumed, repaired or left out.
    """

    source: str
    output: str | None
    trajectory: str | None
    blend: str
    frames: int
    fused: int
    unfused: dict[str, int]
    skipped: tuple[str, ...]
    points: int
    coloured_percent: float
    removed_in_boxes: int
    removed_by_rays: int
    unjudged: int
    written: int
    exposure: ExposureReport | None
    labels: LabelReport | None
    cameras: tuple[CameraReport, ...]
    files: dict[str, int]
    seconds: float
    warnings: tuple[DataWarning, ...]
