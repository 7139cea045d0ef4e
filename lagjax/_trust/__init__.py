"""Checks of results: faults of a scene before integration, the reason of a failed motion, and the error of others.

`checks/` examines a scene at a state, `health/` a trajectory; `_diagnosis` explains a failed motion, with the line of
code; `_precision` has `work_precision`: run time against accuracy.
"""

from lagjax._trust._diagnosis import describe_failure
from lagjax._trust._precision import WorkPrecision, WorkPrecisionRow, work_precision
