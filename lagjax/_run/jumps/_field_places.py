"""The offsets of all fields of a search: in its scene, a member's memory, a record row, a thread's scratch.

A scene is a row of integers: first named ones, then arrays. For memories, records and scratch it has the offset of each
field in doubles. A law declares its own fields after the common ones.
"""

from types import SimpleNamespace

import numpy as np

from lagjax._native import Struct

SIZES = (
    "N",  # coordinates
    "MODES",  # each with a kernel and watches of its own
    "WATCHES",  # the most of a mode
    "NUMBERS", "INPUTS",  # of the user's parameters; of lines: the state, the time, the numbers, and what a law adds
    "TIMES", "STRIDE",  # outputs, and from those of one member to those of the next
    "DOING",  # numbers that say what happens at an output
    "ROOM",  # rounds that a record has room for
    "MOST",  # rounds of a whole motion
    "SINGLE",  # 1 if the start came in float32
    "MEMORY", "ROW", "WORK",  # doubles of a memory, of a row of the record, of the room of a thread
    "REST",  # the most doubles that a kernel leaves behind
    "BEGIN",  # the address of what runs kernels
)  # fmt: skip
ARRAYS = (
    "COUNTS",  # (modes,), the watches of each
    # Addresses of machine code, 0 where there is none yet, of each mode: plans of its kernel for one and many members,
    # and its watches.
    "PLANS", "WATCH", "ERRORS", "SLOPES",
)  # fmt: skip
# Each field with the count of its doubles, by the sizes; "" is one number.
MEMORY = {
    "X": "inputs",  # of lines
    "WIDTHS": "inputs",  # how far the start, t and the numbers are known, where they came in float32
    "RTOL": "", "FIRST": "", "LAST": "",  # the first and the last of the output times
    "BEGUN": "2 * n + 1",  # y and t where it began
    "GUARDS": "5 * watches",  # where the stretch begins
    "RESULT": "", "ROUNDS": "", "ROWS": "", "ACCEPTED": "", "REJECTED": "",
}  # fmt: skip
WORK = {"ORDER": "0", "JOBS": "0"}  # the members whose stretch comes next, and what the kernel is given and gives
RECORD = {
    "RAN": "",  # 1 if there was such a stretch
    "END": "", "STOP": "2 * n",  # of the stretch, and the state there
    "WATCH": "", "CROSSES": "", "DECIDES": "",
}  # fmt: skip


class Places:
    """The field offsets of a law, whose fields are given in dictionaries like those above; the last of `work` is FREE.

    The fields `said` of a row are those that the user's results contain.
    """

    def __init__(self, sizes: tuple, arrays: tuple, memory: dict, work: dict, said: dict, record: dict):
        numbers, self.arrays = (*SIZES, *sizes), (*ARRAYS, *arrays)
        self.memory, self.work, self.said = MEMORY | memory, work | WORK, {"HAPPENS": ""} | said
        self.record = self.said | RECORD | record
        self.fields = self.memory | self.work | self.record
        to_record = [f"TO_{name}" for name in self.record]
        self.names = (*numbers, *self.arrays, *self.memory, *self.work, *to_record)
        self.of = {name: i for i, name in enumerate(self.names)}
        assert len(self.of) == len(self.names), "two fields of one name"
        kinds = self.memory, self.work, self.record
        assert all(self.fields[name] == of[name] for of in kinds for name in of), "two counts of one name"
        self.at = SimpleNamespace(**self.of)
        self.structs = {
            "Scene": Struct({x.lower(): self.of[x] for x in (*numbers, *self.arrays)}, _lower_case(numbers), None),
            "Member": self._struct_layout(self.memory), "Room": self._struct_layout(self.work),
            "Entry": self._struct_layout(self.record, "TO_"),
        }  # fmt: skip

    def _struct_layout(self, fields: dict[str, str], prefix: str = "") -> Struct:
        places = {name.lower(): self.of[prefix + name] for name in fields}
        return Struct(places, _lower_case(name for name in fields if not fields[name]), "scene")

    def count_doubles(self, sizes: dict[str, int]) -> dict[str, int]:
        """The number of doubles in each field of a memory, of the scratch memory of a thread and of a row."""
        known = {name.lower(): size for name, size in sizes.items()}
        return {name: eval(count or "1", {}, known) for name, count in self.fields.items()}

    def write_scene(self, sizes: dict[str, int], arrays: dict[str, np.ndarray], fields: dict[str, int]) -> np.ndarray:
        """The row of integers, without addresses; `fields` are the sizes of all fields in doubles."""
        scene = np.zeros(len(self.names) + sum(np.size(x) for x in arrays.values()), np.int64)
        for name, size in sizes.items():
            scene[self.of[name]] = size
        place = len(self.names)
        for name in self.arrays:
            scene[self.of[name]], numbers = place, np.ravel(arrays[name])
            scene[place : place + numbers.size], place = numbers, place + numbers.size
        for names, whole, prefix in ((self.memory, "MEMORY", ""), (self.work, "WORK", ""), (self.record, "ROW", "TO_")):
            ends = np.cumsum([0, *(fields[name] for name in names)])
            for name, begin in zip(names, ends, strict=False):
                scene[self.of[prefix + name]] = begin
            scene[self.of[whole]] = ends[-1]
        return scene


def _lower_case(names) -> frozenset[str]:
    return frozenset(name.lower() for name in names)
