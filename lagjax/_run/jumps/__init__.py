"""Motions that jump: a search for what happens, over numbers, and a replay, which has derivatives; for any law.

    a law ─► _field_places (the fields of what it reads and writes) ─► _driver (its loop over members and stretches)
          ─► _scene_code (a scene by addresses, its runs) ─► _round_replay (the same with derivatives)

`contacts/` and `hybrid/` have the laws.
"""

from lagjax._run.jumps._driver import GOING, LEAST, bind_law, bind_loops, copy, find_sign
from lagjax._run.jumps._field_places import Places
from lagjax._run.jumps._round_replay import Replay, join, mask_rows
from lagjax._run.jumps._scene_code import Found, JumpLaw, Mode, SceneCode, tolerances_of

__all__ = [
    "GOING", "LEAST", "Found", "JumpLaw", "Mode", "Places", "Replay", "SceneCode", "bind_law", "bind_loops", "copy",
    "find_sign", "join", "mask_rows", "tolerances_of",
]  # fmt: skip
