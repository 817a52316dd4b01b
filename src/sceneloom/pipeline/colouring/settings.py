"""What a colouring is asked to do and to write."""

from dataclasses import dataclass
from math import isfinite
from pathlib import Path

from sceneloom.errors import OptionError
from sceneloom.formats.clouds.writing import WRITTEN_SUFFIXES, check_cloud_suffix
from sceneloom.formats.output import check_output

BLENDS = ("nearest", "best", "weighted")
"""How the colours of several images become one: that of the pixel nearest to an image's middle, that which is
trusted most, between pixels, or the mean of all that agree with it."""

SCENE_SUFFIX = ".sfs"


@dataclass(frozen=True, slots=True, kw_only=True)
class ColourSettings:
    """How a drive is coloured.

    Attributes:
        blend: one of `BLENDS`.
        exposure: whether differences in exposure are evened out.
        voxel: side of the cubes of which the map keeps one point each [m]; None: it keeps all points.
        remove_moving: whether points on what moved are left out.
        labels: folder of label images that are painted onto the points.
        only_coloured: whether points that no image shows are left out.
        provenance: whether clouds report each point camera, image, pixel and weight.
        label_radius_px: of the square that a point fills in projected label images beside its pixel.
        threads: how many share the work on a sweep; what they give is the same.

    Raises:
        OptionError: a value is not one that can be followed.
    """

    blend: str = "weighted"
    exposure: bool = True
    voxel: float | None = None
    remove_moving: bool = False
    labels: Path | None = None
    only_coloured: bool = False
    provenance: bool = False
    label_radius_px: int = 0
    threads: int = 1

    def __post_init__(self) -> None:
        if self.blend not in BLENDS:
            raise OptionError(f"blend {self.blend!r}; expected one of {', '.join(BLENDS)}")
        if self.voxel is not None and not (isfinite(self.voxel) and 0.001 <= self.voxel <= 1000):
            raise OptionError(f"voxel {self.voxel}; expected 0.001 to 1000 m")
        if not 0 <= self.label_radius_px <= 100:
            raise OptionError(f"label_radius_px {self.label_radius_px}; expected 0 to 100")
        if not 1 <= self.threads <= 256:
            raise OptionError(f"threads {self.threads}; expected 1 to 256")


@dataclass(frozen=True, slots=True, kw_only=True)
class ColourOutputs:
    """Where a colouring writes what; None: not at all.

    Attributes:
        map: the whole drive as one cloud: .las, .laz, .ply, .pcd or .sfs.
        per_sweep: a folder of clouds, one for each sweep, or an .sfs file of the fused drive.
        project_labels: folder of label images of the scene's labelled points.
        images: folder of images for people.
        overwrite: whether outputs that exist may be replaced.
    """

    map: Path | None = None
    per_sweep: Path | None = None
    project_labels: Path | None = None
    images: Path | None = None
    overwrite: bool = False

    @property
    def sweep_suffix(self) -> str:
        """Ending of the clouds of single sweeps: that of the map, if it can be one."""
        suffix = "" if self.map is None else self.map.suffix.lower()
        return suffix if suffix in WRITTEN_SUFFIXES else ".ply"

    @property
    def scene_of_sweeps(self) -> bool:
        """Whether the sweeps go into one scene file."""
        return self.per_sweep is not None and self.per_sweep.suffix.lower() == SCENE_SUFFIX

    def check(self) -> None:
        """Refuse outputs that cannot be, before much is done.

        Raises:
            OptionError: there is nothing to write, a suffix is unknown, or two outputs have one name.
            OutputError: an output exists, or its folder is missing.
        """
        locations = [
            location
            for location in (self.map, self.per_sweep, self.project_labels, self.images)
            if location is not None
        ]
        if not locations:
            raise OptionError(
                "nothing to write: name a map (`-o map.laz`), a folder for sweeps (`--per-sweep DIR`), "
                "for label images (`--project-labels DIR`) or for images (`--visualize DIR`)"
            )
        if len({location.absolute() for location in locations}) < len(locations):
            raise OptionError(f"{locations[0]}: named twice; expected a name for each output")
        if self.map is not None and self.map.suffix.lower() != SCENE_SUFFIX:
            try:
                check_cloud_suffix(self.map)
            except OptionError as error:
                raise OptionError(f"{error}, or {SCENE_SUFFIX} for a scene") from None
        for location in locations:
            check_output(location, overwrite=self.overwrite)
