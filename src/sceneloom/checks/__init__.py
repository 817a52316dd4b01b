"""The rules of `sceneloom validate`: each with an id, a severity, a remedy, and a fix where that is safe."""

from typing import TYPE_CHECKING

from sceneloom.lazy import names_on_first_use

if TYPE_CHECKING:
    from sceneloom.checks.rule import Hit, Rule
    from sceneloom.checks.validation import ValidationReport, all_rules, chosen_rules, validate
else:
    __getattr__, __dir__ = names_on_first_use(
        __name__, {"rule": "Hit Rule", "validation": "ValidationReport all_rules chosen_rules validate"}
    )

__all__ = ["Hit", "Rule", "ValidationReport", "all_rules", "chosen_rules", "validate"]
