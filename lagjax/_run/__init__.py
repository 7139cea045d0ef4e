"""The integration of a scene from its start: a motion in the user's own pytree.

`_simulate` has `simulate` and `simulate_batch`, `_crossings` the instants at which a function of the state changes
sign, `hybrid/` motions through modes, `contacts/` those with contacts, `jumps/` what these two share. `_trajectory` is
the type of their results, `_batch_members` its members along one axis, `_states_between` its states between outputs.
"""

from lagjax._run._batch_members import Members
from lagjax._run._crossings import Crossings, crossings, directions_of, restore_crossings, sections_of, surfaces_in
from lagjax._run._simulate import simulate, simulate_batch, trajectory_of
from lagjax._run._states_between import find_states
from lagjax._run._trajectory import CHANGE_WORDS, ContactChanges, Impacts, State, Trajectory, Transitions
