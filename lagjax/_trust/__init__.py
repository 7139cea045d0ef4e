"""Trust: faults of a scene before it moves, the reason why a motion failed, and the error of one that did not.

`checks/` looks at a scene before it moves, `health/` at a trajectory; `_diagnosis` says what a failed motion ran into,
with the line of code; `_precision` holds `work_precision`: what a digit costs.
"""

from lagjax._trust._diagnosis import describe_failure
from lagjax._trust._precision import WorkPrecision, WorkPrecisionRow, work_precision
