"""The fields that the search for contacts reads and writes, in addition to those of every search."""

from typing import TYPE_CHECKING, Any

from lagjax._run.jumps import Places

SIZES = (
    "K", "R", "D",  # contacts, those with friction, the directions in which these slip
    "GAPS",  # contacts with a gap; the others are one-way velocities
    "CORNERS", "SECTIONS",  # of watches there are k normal ones, r of friction, two a corner, sections
    "LAW",  # 0 simultaneous, 1 sequential, 2 Poisson's
    "MAY_MISS",  # 1 if an operation of the watches may hide a corner from a series
    "HEIGHT", "MULTIPLIERS_COUNT",  # rows of contacts, and of all constraints
    "GAP_SLOTS", "SLOTS",  # rows of gaps and of velocities for which there is room; 0 where rows are as they are
    "RESPONSE", "BENDS", "ACCELERATION", "MULTIPLIERS", "SIDES", "SIDE_SLOPES", "CONSTRUCT",  # addresses of lines
)  # fmt: skip
ARRAYS = (
    "ROUGH",  # (r,), the contacts with friction
    "TANGENTIAL",  # (r d,), the rows of slips among all multipliers
    "TOUCH",  # (corners, k), which corner touches which contact
)  # fmt: skip
MEMORY = {
    "OPENED": "inputs",  # of lines, q, q̇, t, the user's numbers, then what contacts do, with all contacts open
    "RESTITUTION": "k", "MU": "r",
    "FRESH": "watches",  # whether what a watch follows has begun at this instant
    "TIED": "k + r",  # whether it turns at this instant by rounding between open and closed, sticking and sliding
    "REFUTED": "k",  # whether a contact has opened there
    "FORCE_NOISE": "k",  # the force that rounding of a gap and of its rate could make in a step
    # The largest of a watch of an open or sliding contact, and of others.
    "ROUNDING": "2 * watches", "RATE_ROUNDING": "2 * watches",
    "CAME": "sections",  # the sides from which the motion comes
    "SLIP": "r",  # the largest so far
    "LARGEST": "2 * n",  # the largest numbers of the state so far
    "KINDS": "watches", "STAYS": "watches",  # of the stretch: what contacts do, and what does not cross
    "MISSED": "", "TURNS": "", "LONGEST": "",
    "DOUBTS": "3", "DOUBTED": "3",  # as in `ContactChanges`
}  # fmt: skip
SIZE = "(k + r * d)"  # the rows of contacts
WORK = {
    # The rows of contacts, as `ImpactRows`.
    "GRADIENTS": f"{SIZE} * n", "RESPONSES": f"{SIZE} * n", "COUPLING": f"{SIZE} ** 2", "VALUES": SIZE, "RATES": SIZE,
    "BEND": SIZE,
    "WATCHED": "5 * watches",  # of open contacts
    "TOUCHES": "k", "PARTING": "k", "NOISE": "k",  # which touch, how fast they move apart, and the rounding of that
    "INVOLVED": "k",  # which take part in an impact
    "CLOSED": "k", "STUCK": "r",  # what they did before
    "PUSH": "k", "STAY": "k", "PARTS": "k", "CHANGED": "k",
    "SLIPS": "2 * r", "SLIPS_BEHIND": "2 * r",  # which are none, and all lengths
    "TURNS_BACK": "r",
    "TARGETS": "k",  # the rates behind an impact
    "FORCES": "d",  # those of all constraints
    "IMPULSES": SIZE, "APART": SIZE,  # and the rates behind them
    "JUMP": "n",  # of velocities
    "CORNER": "3 * corners", "PASSED": "corners", "OPENING": "k",
    "SHIFT": "2 * n", "LATER": "",  # by how much the state and the time go beyond corners
    # What the law takes, 12 s² + 40 s + 40, and lines.
    "FREE": f"13 * {SIZE} ** 2 + (43 + 2 * n) * {SIZE} + 40 + 4 * inputs + 20 * watches + 4 * corners"
    " + multipliers_count",
}  # fmt: skip
SAID = {
    "CONTACT": "", "CHANGE": "", "HITS": "",
    "AT": "", "BEFORE": "n", "BEHIND": "2 * n",  # the time of the change, q̇ before it, the state behind it
    "T_IMPACT": "", "IMPULSE": "k", "LOST": "",
}  # fmt: skip
RECORD = {
    "DID": "doing",  # what the contacts did during it, as the inputs of lines have it
    "HELD": SIZE, "SLIDES": "r", "DIRECTION": "r * d",  # of the impulses: rows, the contacts that slide, and where
    "COMPRESSED": "k", "RETURNED": "k",  # rows of the phases of Poisson's law
    "ENDS": "k", "MEETS": "k",  # whose bounces end, whose gaps close
    # By how much what they share may vary apart, 0 of others: of contacts that share an impact and close by themselves,
    # of those that break away where the motion starts.
    "SHARES": "k", "STARTS": "r",
    "LEAVES_REST": "",
    "OFFSET": "2 * n", "LATER_ON": "",  # by how much the state is moved besides; and the time
}  # fmt: skip
PLACES = Places(SIZES, ARRAYS, MEMORY, WORK, SAID, RECORD)

if TYPE_CHECKING:  # whose fields are known at run time
    Scene = Member = Entry = Room = Any
else:
    Scene, Member, Room, Entry = (PLACES.structs[name] for name in ("Scene", "Member", "Room", "Entry"))
