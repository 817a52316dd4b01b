"""The rules of `sceneloom validate`: each with an id, a severity, a remedy, and a fix where that is safe."""

from typing import TYPE_CHECKING

from sceneloom.lazy import names_on_first_use

if TYPE_CHECKING:
    from sceneloom.checks.rule import ALL_PROFILES, SCALE_ONLY, CheckProfile, FrameInHand, Hit, Rule, Subject
    from sceneloom.checks.validation import (
        LOCATIONS,
        RULE_TABLES,
        RuleRow,
        ValidationReport,
        all_rules,
        chosen_rules,
        validate,
    )
else:
    __getattr__, __dir__ = names_on_first_use(
        __name__,
        {
            "ALL_PROFILES": "sceneloom.checks.rule:ALL_PROFILES",
            "LOCATIONS": "sceneloom.checks.validation:LOCATIONS",
            "RULE_TABLES": "sceneloom.checks.validation:RULE_TABLES",
            "SCALE_ONLY": "sceneloom.checks.rule:SCALE_ONLY",
            "CheckProfile": "sceneloom.checks.rule:CheckProfile",
            "FrameInHand": "sceneloom.checks.rule:FrameInHand",
            "Hit": "sceneloom.checks.rule:Hit",
            "Rule": "sceneloom.checks.rule:Rule",
            "RuleRow": "sceneloom.checks.validation:RuleRow",
            "Subject": "sceneloom.checks.rule:Subject",
            "ValidationReport": "sceneloom.checks.validation:ValidationReport",
            "all_rules": "sceneloom.checks.validation:all_rules",
            "chosen_rules": "sceneloom.checks.validation:chosen_rules",
            "validate": "sceneloom.checks.validation:validate",
        },
    )

__all__ = [
    "ALL_PROFILES",
    "LOCATIONS",
    "RULE_TABLES",
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
