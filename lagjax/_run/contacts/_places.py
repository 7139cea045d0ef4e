"""The places of what the search for contacts reads and writes, beside those that every search has."""

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
    "RESPONSE", "BENDS", "ACCELERATION", "MULTIPLIERS", "SIDES", "SIDE_SLOPES",  # addresses of lines
)  # fmt: skip
ARRAYS = (
    "ROUGH",  # (r,), the contacts with friction
    "TANGENTIAL",  # (r d,), the rows of slips among all multipliers
    "TOUCH",  # (corners, k), which corner touches which contact
)  # fmt: skip
MEMORY = (
    "OPENED",  # the inputs of lines, q, q̇, t, the user's numbers, then what contacts do, with all contacts open
    "RESTITUTION", "MU",  # (k,), (r,)
    "FRESH",  # (G,), whether what a watch follows has begun at this instant
    "TIED",  # (k + r,), whether it turns at this instant by rounding between open and closed, sticking and sliding
    "REFUTED",  # (k,), whether a contact has opened there
    "FORCE_NOISE",  # (k,), the force that rounding of a gap and of its rate could make in a step
    "ROUNDING", "RATE_ROUNDING",  # (2, G), the largest of a watch of an open or sliding contact, and of others
    "CAME",  # (sections,), the sides from which the motion comes
    "SLIP",  # (r,), the largest so far
    "LARGEST",  # (2n,), the largest numbers of the state so far
    "KINDS", "STAYS",  # (G,) of the stretch: what contacts do, and what does not cross
    "MISSED", "TURNS", "LONGEST",
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
)  # fmt: skip
SAID = (
    "CONTACT", "CHANGE", "HITS",
    "AT", "BEFORE", "BEHIND",  # the time of the change, q̇ before it, the state behind it
    "T_IMPACT", "IMPULSE", "LOST",
)  # fmt: skip
RECORD = (
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
_SCALARS = ("MISSED", "TURNS", "LONGEST", "CONTACT", "CHANGE", "HITS", "AT", "T_IMPACT", "LOST",
            "LEAVES_REST", "LATER_ON")  # fmt: skip
PLACES = Places(SIZES, ARRAYS, MEMORY, WORK, SAID, RECORD, _SCALARS, in_room=("LATER",))

if TYPE_CHECKING:  # whose fields are known at run time
    Scene = Member = Entry = Room = Any
else:
    Scene, Member, Room, Entry = (PLACES.structs[name] for name in ("Scene", "Member", "Room", "Entry"))


def sizes_of(sizes: dict[str, int]) -> dict[str, int]:
    """The count of doubles in each field that has not one, beside those of every search."""
    n, k, r, d, corners, watches, inputs, doing = (
        sizes[name] for name in ("N", "K", "R", "D", "CORNERS", "WATCHES", "INPUTS", "DOING")
    )
    size = k + r * d
    law = 12 * size**2 + 40 * size + 40
    lines = 4 * inputs + 2 * size * n + size**2 + 3 * size + 20 * watches + 4 * corners + sizes["MULTIPLIERS_COUNT"]
    per_contact = (
        "RESTITUTION", "REFUTED", "FORCE_NOISE", "TOUCHES", "PARTING", "NOISE", "INVOLVED", "CLOSED", "PUSH", "STAY",
        "PARTS", "CHANGED", "TARGETS", "OPENING", "IMPULSE", "COMPRESSED", "RETURNED", "ENDS", "MEETS", "SHARES",
    )  # fmt: skip
    fields = dict.fromkeys(per_contact, k) | dict.fromkeys(("MU", "SLIP", "STUCK", "TURNS_BACK", "SLIDES", "STARTS"), r)
    fields |= dict.fromkeys(("VALUES", "RATES", "BEND", "IMPULSES", "APART", "HELD"), size)
    fields |= dict.fromkeys(("LARGEST", "SHIFT", "BEHIND", "OFFSET"), 2 * n)
    fields |= {"OPENED": inputs} | dict.fromkeys(("DOUBTS", "DOUBTED"), 3)
    fields |= dict.fromkeys(("FRESH", "KINDS", "STAYS"), watches)
    fields |= dict.fromkeys(("ROUNDING", "RATE_ROUNDING"), 2 * watches)
    fields |= dict.fromkeys(("GRADIENTS", "RESPONSES"), size * n) | dict.fromkeys(("SLIPS", "SLIPS_BEHIND"), 2 * r)
    fields |= {
        "WATCHED": 5 * watches, "TIED": k + r, "CAME": sizes["SECTIONS"], "COUPLING": size**2, "FORCES": d, "CHANGE": n,
        "CORNER": 3 * corners, "PASSED": corners, "FREE": law + lines, "DID": doing,
        "BEFORE": n, "DIRECTION": r * d,
    }  # fmt: skip
    return fields
