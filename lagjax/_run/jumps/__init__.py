"""Motions that jump: a search for events, over numbers, and a replay with derivatives; for any law.

    a law ─► _field_places (the fields that it reads and writes) ─► _driver (its loop over members and stretches)
          ─► _scene_code (a scene by addresses, its runs) ─► _round_replay (the same with derivatives)

A *law* is the pair of loops and fields that decides what happens at the end of a stretch: those of `contacts/` and
`hybrid/`.
"""

from lagjax._run.jumps._driver import GOING, LEAST, bind_law, bind_loops, copy, find_sign
from lagjax._run.jumps._field_places import Places
from lagjax._run.jumps._round_replay import Replay, concatenate, mask_rows
from lagjax._run.jumps._scene_code import Found, JumpLaw, Mode, SceneCode, tolerances_of

__all__ = [
    "GOING", "LEAST", "Found", "JumpLaw", "Mode", "Places", "Replay", "SceneCode", "bind_law", "bind_loops",
    "concatenate", "copy", "find_sign", "mask_rows", "tolerances_of",
]  # fmt: skip
