"""Many drives: one verb over all of them, with a record of the run that can be taken up again."""

from typing import TYPE_CHECKING

from sceneloom.lazy import names_on_first_use

if TYPE_CHECKING:
    from sceneloom.batch.jobs import Input, Job, Outcome, State, Task
    from sceneloom.batch.running import RunSummary, run
else:
    __getattr__, __dir__ = names_on_first_use(
        __name__, {"jobs": "Input Job Outcome State Task", "running": "RunSummary run"}
    )

__all__ = ["Input", "Job", "Outcome", "RunSummary", "State", "Task", "run"]
