"""The rules of `sceneloom validate`: each with an id, a severity, a remedy, and a fix where that is safe."""

from typing import TYPE_CHECKING

from sceneloom.lazy import names_on_first_use

if TYPE_CHECKING:
    from sceneloom.checks.catalogue import RULE_MODULES, RuleRow, all_rules, chosen_rules
    from sceneloom.checks.report import LOCATIONS, ValidationReport
    from sceneloom.checks.rule import ALL_PROFILES, SCALE_ONLY, CheckProfile, Hit, Rule
    from sceneloom.checks.subject import FrameInHand, Subject
    from sceneloom.checks.validation import validate
else:
    __getattr__, __dir__ = names_on_first_use(
        __name__,
        {
            "ALL_PROFILES": "sceneloom.checks.rule:ALL_PROFILES",
            "LOCATIONS": "sceneloom.checks.report:LOCATIONS",
            "RULE_MODULES": "sceneloom.checks.catalogue:RULE_MODULES",
            "SCALE_ONLY": "sceneloom.checks.rule:SCALE_ONLY",
            "CheckProfile": "sceneloom.checks.rule:CheckProfile",
            "FrameInHand": "sceneloom.checks.subject:FrameInHand",
            "Hit": "sceneloom.checks.rule:Hit",
            "Rule": "sceneloom.checks.rule:Rule",
            "RuleRow": "sceneloom.checks.catalogue:RuleRow",
            "Subject": "sceneloom.checks.subject:Subject",
            "ValidationReport": "sceneloom.checks.report:ValidationReport",
            "all_rules": "sceneloom.checks.catalogue:all_rules",
            "chosen_rules": "sceneloom.checks.catalogue:chosen_rules",
            "validate": "sceneloom.checks.validation:validate",
        },
    )

__all__ = [
    "ALL_PROFILES",
    "LOCATIONS",
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
    "chosen_rules",
    "validate",
]
