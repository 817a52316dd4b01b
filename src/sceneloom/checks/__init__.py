"""The rules of `sceneloom validate`: each with an id, a severity, a remedy, and a fix where that is safe."""

from sceneloom.checks.catalogue import RULE_MODULES, RuleRow, all_rules, catalogue, chosen_rules
from sceneloom.checks.report import PLACES, ValidationReport
from sceneloom.checks.rule import ALL_PROFILES, SCALE_ONLY, CheckProfile, Hit, Rule
from sceneloom.checks.subject import FrameInHand, Subject
from sceneloom.checks.validation import validate

__all__ = [
    "ALL_PROFILES",
    "PLACES",
    "RULE_MODULES",
    "SCALE_ONLY",
    "CheckProfile",
    "FrameInHand",
    "Hit",
    "Rule",
    "RuleRow",
    "Subject",
    "ValidationReport",
    "all_rules",
    "catalogue",
    "chosen_rules",
    "validate",
]
