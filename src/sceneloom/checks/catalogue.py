"""All rules: one row per module that offers some."""

from collections.abc import Iterable
from importlib import import_module

import msgspec

from sceneloom.checks.rule import ALL_PROFILES, CheckProfile, Rule
from sceneloom.errors import OptionError

RULE_MODULES: tuple[str, ...] = (
    "sceneloom.checks.reading",
    "sceneloom.checks.fields",
    "sceneloom.checks.recordings.faults",
    "sceneloom.checks.recordings.presence",
    "sceneloom.checks.recordings.times",
    "sceneloom.checks.recordings.imu_times",
    "sceneloom.checks.recordings.imu_values",
    "sceneloom.checks.recordings.sensor_values",
    "sceneloom.checks.recordings.fixes",
    "sceneloom.checks.recordings.fixes_rotating",
    "sceneloom.checks.recordings.pose_steps",
    "sceneloom.checks.recordings.configuration",
    "sceneloom.checks.recordings.frame_lines",
    "sceneloom.checks.recordings.calibration_entries",
    "sceneloom.checks.recordings.calibrated_camera_models",
    "sceneloom.checks.recordings.mountings",
    "sceneloom.checks.recordings.stereo_images",
    "sceneloom.checks.recordings.lidar_lines",
    "sceneloom.checks.times",
    "sceneloom.checks.point_times",
    "sceneloom.checks.poses",
    "sceneloom.checks.recordings.poses_and_imu",
    "sceneloom.checks.recordings.poses_and_gnss",
    "sceneloom.checks.recordings.repaired_streams",
    "sceneloom.checks.sensors",
    "sceneloom.checks.cameras",
    "sceneloom.checks.points",
    "sceneloom.checks.point_frames",
    "sceneloom.checks.surroundings",
    "sceneloom.checks.images",
    "sceneloom.checks.references",
    "sceneloom.checks.annotation_times",
    "sceneloom.checks.attributes",
    "sceneloom.checks.cuboids",
    "sceneloom.checks.cuboid_angles",
    "sceneloom.checks.boxes_in_images",
    "sceneloom.checks.shapes",
    "sceneloom.checks.labelled_points",
    "sceneloom.checks.corrections",
    "sceneloom.checks.scale",
)
"""The modules that offer `RULES`, in the order in which a person would look."""


def all_rules() -> tuple[Rule, ...]:
    """Every rule of every profile."""
    return tuple(rule for module in RULE_MODULES for rule in import_module(module).RULES)


def chosen_rules(
    profile: CheckProfile | str, *, only: Iterable[str] = (), ignored: Iterable[str] = ()
) -> tuple[Rule, ...]:
    """The rules of a profile: only those that are named, but for those that are to be ignored.

    Raises:
        OptionError: there is no such profile, or no such rule.
    """
    profiles = [known.value for known in CheckProfile]
    if profile not in profiles:
        raise OptionError(f"profile {profile!r}; expected one of {', '.join(profiles)}")
    rules, only, ignored = all_rules(), frozenset(only), frozenset(ignored)
    known_ids = {rule.id for rule in rules}
    for identifier in sorted((only | ignored) - known_ids):
        raise OptionError(f"no rule {identifier!r}; `sceneloom validate --rules` lists them")
    return tuple(
        rule
        for rule in rules
        if CheckProfile(profile) in rule.profiles and rule.id not in ignored and (not only or rule.id in only)
    )


class RuleRow(msgspec.Struct, frozen=True, kw_only=True):
    """One rule as a list of rules reports it.

    Attributes:
        id: of the rule.
        severity: how bad a finding is.
        summary: what holds in a sound scene.
        remedy: what a person can do.
        fixable: whether `--fix` repairs it.
        only_in: the profiles that it is limited to; () for all.
    """

    id: str
    severity: str
    summary: str
    remedy: str
    fixable: bool
    only_in: tuple[str, ...] = ()


def catalogue() -> tuple[RuleRow, ...]:
    """All rules, those of one room together."""
    return tuple(
        RuleRow(
            id=rule.id,
            severity=rule.severity.value,
            summary=rule.summary,
            remedy=rule.remedy,
            fixable=rule.fix is not None,
            only_in=() if rule.profiles == ALL_PROFILES else tuple(sorted(p.value for p in rule.profiles)),
        )
        for rule in all_rules()
    )
