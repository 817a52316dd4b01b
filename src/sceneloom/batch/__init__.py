"""Many drives: one verb over all of them, with a record of the run that can be taken up again."""

from sceneloom.batch.jobs import Input, Job, Outcome, State, Task
from sceneloom.batch.running import RunSummary, run

__all__ = ["Input", "Job", "Outcome", "RunSummary", "State", "Task", "run"]
