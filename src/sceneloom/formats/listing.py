"""What there is to state of each format, for people who choose one."""

import msgspec

from sceneloom.errors import OptionError
from sceneloom.formats.base.losses import Holding, Supports, holding_of
from sceneloom.formats.base.registry import format_named, format_names
from sceneloom.formats.base.spec import FormatSpec
from sceneloom.formats.trajectories.table import TRAJECTORY_FORMS
from sceneloom.formats.trajectories.trajectory_file import TrajectoryForm
from sceneloom.scene.contents import MODEL_FIELDS


class FormatListing(msgspec.Struct, frozen=True, kw_only=True):
    """One format of scenes, or form of files of a trajectory.

    Attributes:
        name: by which it is chosen.
        reads, writes: whether it is read, and written.
        suffixes: of its files; "" for a folder.
        looks_like: what it is recognised by.
        trajectory: whether its files hold one trajectory and nothing else.
    """

    name: str
    reads: bool
    writes: bool
    suffixes: tuple[str, ...]
    looks_like: str
    trajectory: bool = False


def list_formats() -> tuple[FormatListing, ...]:
    """Give all formats of scenes, then all forms of trajectories."""
    return (*map(_of_format, map(format_named, format_names())), *map(_of_form, TRAJECTORY_FORMS.values()))


def list_supported_fields(name: str) -> dict[str, Holding]:
    """Report what becomes of each field of the model in a format that is written; nothing for one that is only read.

    Fields that the format says nothing of are left out; what depends on the scene shows in the report of a conversion.

    Raises:
        OptionError: there is no format or form of that name.
    """
    supports = _supports(name)
    found = {field: holding_of(supports, field) for field in MODEL_FIELDS}
    return {field: holding for field, holding in found.items() if holding is not None}


def _supports(name: str) -> Supports:
    # of a scene format and a form of trajectories that share a name, scenes come first
    if name in format_names():
        return format_named(name).supports
    if name in TRAJECTORY_FORMS:
        return TRAJECTORY_FORMS[name].supports
    raise OptionError(f"no format or form {name!r}; there are {', '.join((*format_names(), *TRAJECTORY_FORMS))}")


def _of_format(form: FormatSpec) -> FormatListing:
    return FormatListing(
        name=form.name, reads=form.reads, writes=form.writes, suffixes=tuple(form.suffixes), looks_like=form.looks_like
    )


def _of_form(form: TrajectoryForm) -> FormatListing:
    return FormatListing(
        name=form.name, reads=True, writes=True, suffixes=form.suffixes, looks_like=form.looks_like, trajectory=True
    )
