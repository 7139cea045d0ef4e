"""The scene as its author describes it.

`_system` holds `System`; `_samples` inputs that were measured, as functions of time; `_explanation` what a scene
contains, what was left out, and which engine takes it; `_contacts` the contacts of a scene in flat coordinates;
`_driven` makes parameters of the inputs that functions ask for, `_closed_over` of numbers that functions close over
while they are traced.
"""

from lagjax._scene._closed_over import lift_batch, lift_problem
from lagjax._scene._contacts import ContactParams, Contacts, ContactScene, ContactShapes, FlatContacts
from lagjax._scene._driven import (
    DrivenParams,
    add_input_forces,
    constant_inputs,
    drive_function,
    drive_scene,
    roles_with_inputs,
)
from lagjax._scene._explanation import Explanation
from lagjax._scene._samples import HOLDS, MARGINS, append_samples, samples, unevenly_spaced
from lagjax._scene._system import (
    ARGUMENTS,
    ROLES,
    System,
    Time,
    describe_violation,
    drop_contacts,
    present_system,
    replace_functions,
    require_coefficients,
    require_system,
)
