"""The places of what the search for transitions reads and writes, beside those that every search has."""

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
MEMORY = (
    "MODE",
    # Of each transition just before the last reset: the value of its guard, NaN in another mode, and the side of its
    # surface, −1, +1, or 0 where it is unknown; the rounding of the largest terms that it has had, and of its rate's.
    "VALUES", "SIDES", "ROUNDING", "RATE_ROUNDING",
    "LATEST",  # the transition before, −1 at the beginning
    # Of each guard where the stretch begins: the side from which it comes, as large as what rounding does, infinite
    # where it happens at once; until when one on its surface stays there; whether it is beyond zero in its direction,
    # which is no crossing; and a blow of these, which is let out where it comes back.
    "CAME", "LASTING", "BEYOND", "BLOWS",
    "LET_OUT",  # (K,), see `Transitions`
)  # fmt: skip
WORK = (
    "WATCHED", "OTHER",  # (5, G), the watches where the stretch ends, and at another state
    "CLEAR",  # (G,), the rates that rounding does not decide
    "FELL",  # (G,), 1 for watches that fell, 2 for those that rose
    "THERE", "ARMED", "GOES",  # (G,), of blows at one instant
    "AFTER", "ONE", "LARGEST",  # states as inputs of lines, and the largest numbers of some
)  # fmt: skip
SAID = ("AT", "BEFORE", "BEHIND", "MODE", "TARGET", "NUMBER", "ORDER_MATTERS")
_SCALARS = ("LATEST", "AT", "TARGET", "NUMBER", "ORDER_MATTERS")
PLACES = Places(("K",), ARRAYS, MEMORY, WORK, SAID, (), _SCALARS)

if TYPE_CHECKING:  # whose fields are known at run time
    Scene = Member = Entry = Room = Any
else:
    Scene, Member, Room, Entry = (PLACES.structs[name] for name in ("Scene", "Member", "Room", "Entry"))


def sizes_of(sizes: dict[str, int]) -> dict[str, int]:
    """The count of doubles in each field that has not one, beside those of every search."""
    n, watches, inputs = (sizes[name] for name in ("N", "WATCHES", "INPUTS"))
    fields = dict.fromkeys(("VALUES", "SIDES", "ROUNDING", "RATE_ROUNDING", "LET_OUT"), sizes["K"])
    fields |= dict.fromkeys(("WATCHED", "OTHER"), 5 * watches)
    fields |= dict.fromkeys(("CAME", "LASTING", "BEYOND", "BLOWS", "CLEAR", "FELL", "THERE", "ARMED", "GOES"), watches)
    fields |= dict.fromkeys(("AFTER", "ONE"), inputs) | dict.fromkeys(("BEFORE", "BEHIND", "LARGEST"), 2 * n)
    return fields | {"FREE": 3 * inputs + 6 * watches}
