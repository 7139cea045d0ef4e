"""The page for users of other programs: every pair runs, and agrees to the digits that stand beside it."""

import re
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[2] / "examples" / "coming_from.py"
FIRST, *CELLS = re.findall(r"^# %%\n(.*?)(?=^# %%|\Z)", PAGE.read_text(), flags=re.MULTILINE | re.DOTALL)
PEERS = {re.search(r"differ by", cell) and re.search(r'f"(\w+) and', cell)[1]: cell for cell in CELLS}


def test_the_page_has_a_pair_for_everyone():
    assert set(PEERS) == {"diffrax", "heyoka", "SciPy", "MuJoCo", "REBOUND"}
    headings = re.findall(r"^## (.*)$", PAGE.read_text(), flags=re.MULTILINE)
    assert headings == ["diffrax", "heyoka", "SymPy mechanics, and SciPy", "MuJoCo and MJX", "REBOUND"]


@pytest.mark.slow
@pytest.mark.parametrize("peer", PEERS)
def test_both_sides_agree(peer, capsys):
    pytest.importorskip(peer.lower())
    session = {}
    exec(compile(FIRST + PEERS[peer], str(PAGE), "exec"), session)
    difference = float(re.search(r"differ by (\S+)", capsys.readouterr().out)[1])
    assert difference < float(re.search(r"# below (\S+?):?\s", PEERS[peer])[1])
