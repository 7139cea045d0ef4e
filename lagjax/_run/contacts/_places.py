"""The places of what the search for contacts reads and writes: in its scene, a member's memory, a row of a record.

A scene is a row of integers: first those that are named here, then arrays. Of memories and records it holds at which
double each field begins.
"""

from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from lagjax._native import Struct

SIZES = (
    "N",  # coordinates
    "K", "R", "D",  # contacts, those with friction, the directions in which these slip
    "GAPS",  # contacts with a gap; the others are one-way velocities
    "CORNERS", "SECTIONS",
    "WATCHES",  # k normal ones, r of friction, two a corner, sections
    "NUMBERS", "INPUTS",  # of the user's parameters; of lines: the state, the numbers, and what contacts do
    "TIMES", "STRIDE",  # outputs, and from those of one member to those of the next
    "DOING",  # numbers that say what contacts do
    "ROOM",  # rounds that a record has room for
    "MOST",  # rounds of a whole motion
    "LAW",  # 0 simultaneous, 1 sequential, 2 Poisson's
    "SINGLE",  # 1 if the start came in float32
    "MAY_MISS",  # 1 if an operation of the watches may hide a corner from a series
    "HEIGHT", "MULTIPLIERS_COUNT",  # rows of contacts, and of all constraints
    "GAP_SLOTS", "SLOTS",  # rows of gaps and of velocities for which there is room; 0 where rows are as they are
    "MEMORY", "ROW", "WORK",  # doubles of a memory, of a row of the record, of the room of a thread
    # Doubles of what kernels leave behind, of which the last says whether a run is done; and the most of these.
    "OPEN_ONE_REST", "OPEN_MANY_REST", "HELD_ONE_REST", "HELD_MANY_REST", "REST",
)  # fmt: skip
# Addresses of machine code; 0 where there is none yet. Of open contacts alone, and of all.
CODES = (
    "BEGIN",  # of kernels
    "OPEN_ONE", "OPEN_MANY", "HELD_ONE", "HELD_MANY",  # plans of kernels
    "OPEN_WATCH", "HELD_WATCH", "OPEN_ERRORS", "HELD_ERRORS", "OPEN_SLOPES", "HELD_SLOPES",
    "RESPONSE", "BENDS", "ACCELERATION", "MULTIPLIERS", "SIDES", "SIDE_SLOPES",
)  # fmt: skip
ARRAYS = (
    "ROUGH",  # (r,), the contacts with friction
    "TANGENTIAL",  # (r d,), the rows of slips among all multipliers
    "TOUCH",  # (corners, k), which corner touches which contact
)  # fmt: skip
MEMORY = (
    "X",  # the inputs of lines: q, q̇, t, the user's numbers, then what the contacts do
    "OPENED",  # the same with all contacts open
    "RESTITUTION", "MU",  # (k,), (r,)
    "WIDTHS",  # how far the start, t and the numbers are known, where they came in float32
    "RTOL", "FIRST", "LAST",  # the first and the last of the output times
    "BEGUN",  # y and t where it began
    "FRESH",  # (G,), whether what a watch follows has begun at this instant
    "TIED",  # (k + r,), whether it turns at this instant by rounding between open and closed, sticking and sliding
    "REFUTED",  # (k,), whether a contact has opened there
    "FORCE_NOISE",  # (k,), the force that rounding of a gap and of its rate could make in a step
    "ROUNDING", "RATE_ROUNDING",  # (2, G), the largest of a watch of an open or sliding contact, and of others
    "CAME",  # (sections,), the sides from which the motion comes
    "SLIP",  # (r,), the largest so far
    "LARGEST",  # (2n,), the largest numbers of the state so far
    "GUARDS", "KINDS", "STAYS",  # of the stretch: the watches where it begins (5, G), their kinds, what does not cross
    "MISSED", "TURNS", "LONGEST", "RESULT", "ROUNDS", "ROWS", "ACCEPTED", "REJECTED",
    "DOUBTS", "DOUBTED",  # (3,), as in `ContactChanges`
)  # fmt: skip
WORK = (
    "GRADIENTS", "RESPONSES", "COUPLING", "VALUES", "RATES", "BEND",  # the rows of contacts, as `ImpactRows`
    "WATCHED",  # (5, G), the watches of open contacts
    "TOUCHES", "PARTING", "NOISE",  # (k,) each: which touch, how fast they move apart, and the rounding of that
    "INVOLVED",  # (k,), which take part in an impact
    "CLOSED", "STUCK",  # (k,), (r,), what they did before
    "PUSH", "STAY", "PARTS", "CHANGED",  # (k,)
    "SLIPS", "SLIPS_BEHIND",  # (2, r): which are none, and all lengths
    "TURNS_BACK",  # (r,)
    "TARGETS",  # (k,), the rates behind an impact
    "FORCES",  # those of all constraints
    "IMPULSES", "APART",  # (k + r d,), and the rates behind them
    "CHANGE",  # (n,), of velocities
    "CORNER", "PASSED", "OPENING",  # (3, corners), (corners,), (k,)
    "SHIFT", "LATER",  # (2n,), by how much the state and the time go beyond corners
    "FELL",  # (G,), 1 for watches that fell, 2 for those that rose
    "FREE",  # for what is not named
    "ORDER", "JOBS",  # the members whose stretch comes next, and what the kernel is given and gives
)  # fmt: skip
SAID = (  # of a row of the record, what a user is told
    "HAPPENS", "CONTACT", "CHANGE", "HITS",
    "AT", "BEFORE", "BEHIND",  # the time of the change, q̇ before it, the state behind it
    "T_IMPACT", "IMPULSE", "LOST",
)  # fmt: skip
RECORD = (
    *SAID,
    "RAN",  # 1 if there was such a stretch
    "END", "STOP",  # of the stretch, and the state there (2n,)
    "WATCH", "CROSSES", "DECIDES",
    "DID",  # what the contacts did during it, as the inputs of lines have it
    "HELD", "SLIDES", "DIRECTION",  # of the impulses: rows (k + r d,), the contacts that slide (r,), and where (r d,)
    "COMPRESSED", "RETURNED",  # (k,), rows of the phases of Poisson's law
    "ENDS", "MEETS",  # (k,), whose bounces end, whose gaps close
    # By how much what they share may vary apart, 0 of others: (k,) of contacts that share an impact and close by
    # themselves, (r,) of those that break away where the motion starts.
    "SHARES", "STARTS",
    "LEAVES_REST",
    "OFFSET", "LATER_ON",  # (2n,), by how much the state is moved besides; and the time
)  # fmt: skip


NAMES = (*SIZES, *CODES, *ARRAYS, *MEMORY, *WORK, *(f"TO_{name}" for name in RECORD))
_PLACES = {name: i for i, name in enumerate(NAMES)}
assert len(_PLACES) == len(NAMES), "two fields of one name"
at = SimpleNamespace(**_PLACES)
_SCALARS = (
    "RTOL", "FIRST", "LAST", "MISSED", "TURNS", "LONGEST", "RESULT", "ROUNDS", "ROWS", "ACCEPTED", "REJECTED", "LATER",
    "RAN", "END", "WATCH", "CROSSES", "HAPPENS", "DECIDES", "CONTACT", "CHANGE", "HITS", "AT", "T_IMPACT", "LOST",
    "LEAVES_REST", "LATER_ON",
)  # fmt: skip


def _struct(names: tuple[str, ...], scalars: tuple[str, ...] = _SCALARS, prefix: str = "", table: str | None = "scene"):
    places = {name.lower(): _PLACES[prefix + name] for name in names}
    return Struct(places, frozenset(name.lower() for name in names if name in scalars), table)


if TYPE_CHECKING:  # whose fields are known at run time
    Scene = Member = Entry = Room = Any
else:
    Scene = _struct((*SIZES, *CODES, *ARRAYS), (*SIZES, *CODES), table=None)
    Member, Entry = _struct(MEMORY), _struct(RECORD, prefix="TO_")
    Room = _struct(WORK, ("LATER",))
