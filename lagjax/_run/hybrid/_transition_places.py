"""The fields that the search for transitions reads and writes, in addition to those of every search."""

from typing import TYPE_CHECKING, Any

from lagjax._run.jumps import Places

# K is the count of transitions. Of each, those that leave one mode side by side:
ARRAYS = (
    "FIRST_OF",  # (modes,), the place of the first transition that leaves a mode
    "NUMBER", "TARGET", "WAY",  # the place in the list, the mode that it leads to, the direction of its guard
    "FIRES",  # 0 by the target, 1 beyond zero, 2 where it crosses
    "PASSES",  # 1 if the motion continues to the other side though the guard has no rate: no reset, or a jump
    "ALIKE",  # 1 if the guard says something in other modes
    "RESETS",  # addresses of lines, 0 of those that keep the state
    "CHECKS",  # (modes,), addresses of lines that give 1 for a state off the constraints, 0 of modes without any
)  # fmt: skip
MEMORY = {
    "MODE": "1",
    # Of each transition just before the last reset: the value of its guard, NaN in another mode, and the side of its
    # surface, −1, +1, or 0 where it is unknown; the rounding of the largest terms that it has had, and of its rate's.
    "VALUES": "k", "SIDES": "k", "ROUNDING": "k", "RATE_ROUNDING": "k",
    "LATEST": "",  # the transition before, −1 at the beginning
    # Of each guard where the stretch begins: the side from which it comes, as large as what rounding does, infinite
    # where it happens at once; until when one on its surface stays there; whether it is beyond zero in its direction,
    # which is no crossing; and a blow of these, which is let out where it comes back.
    "CAME": "watches", "LASTING": "watches", "BEYOND": "watches", "BLOWS": "watches",
    "LET_OUT": "k",  # see `Transitions`
}  # fmt: skip
WORK = {
    "WATCHED": "5 * watches", "OTHER": "5 * watches",  # where the stretch ends, and at another state
    "CLEAR": "watches",  # the rates that rounding does not decide
    "FELL": "watches",  # 1 for watches that fell, 2 for those that rose
    "THERE": "watches", "ARMED": "watches", "GOES": "watches",  # of blows at one instant
    "AFTER": "inputs", "ONE": "inputs", "LARGEST": "2 * n",  # states as inputs of lines, the largest numbers of some
    "FREE": "3 * inputs + 6 * watches",
}  # fmt: skip
SAID = {"AT": "", "BEFORE": "2 * n", "BEHIND": "2 * n", "MODE": "1", "TARGET": "", "NUMBER": "", "ORDER_MATTERS": ""}
PLACES = Places(("K",), ARRAYS, MEMORY, WORK, SAID, {})

if TYPE_CHECKING:  # whose fields are known at run time
    Scene = Member = Entry = Room = Any
else:
    Scene, Member, Room, Entry = (PLACES.structs[name] for name in ("Scene", "Member", "Room", "Entry"))
