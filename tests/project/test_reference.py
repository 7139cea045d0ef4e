"""The reference: the docstrings are fit for it, and the pages are built."""

import importlib.util
import inspect
import pydoc
import re
import subprocess
import sys
from pathlib import Path

import pytest

import lagjax

ROOT = Path(__file__).parents[2]
PUBLIC = {name: getattr(lagjax, name) for name in (*lagjax.__all__, *lagjax.results.__all__)}


def returned_by_public_functions() -> str:
    """The annotations of what public functions, and methods of public classes, return."""
    owners = [lagjax, *(thing for thing in PUBLIC.values() if inspect.isclass(thing))]
    members = [inspect.getattr_static(owner, name) for owner in owners for name in dir(owner) if name[0] != "_"]
    returned = [getattr(thing, "__annotations__", {}).get("return", "") for thing in members]
    return " ".join(f"{getattr(kind, '__name__', '')} {kind}" for kind in returned)


def test_the_package_tells_of_every_public_name():
    named = set(re.findall(r"`(\w+)`", inspect.getdoc(lagjax)))
    assert set(PUBLIC) <= named, f"lagjax/__init__.py: its docstring lacks {sorted(set(PUBLIC) - named)}"


def test_every_docstring_begins_with_one_sentence():
    for name, thing in PUBLIC.items():
        summary = inspect.getdoc(thing).split("\n\n")[0]
        assert summary.endswith((".", ":")), f"the docstring of {name} does not begin with a sentence: {summary!r}"
        assert len(inspect.getdoc(thing).split("\n")[0]) <= 120


def test_every_function_has_an_example():
    for name, thing in PUBLIC.items():
        if inspect.isfunction(thing):
            assert "```python" in inspect.getdoc(thing), f"the docstring of {name} has no example"


def test_every_class_has_an_example_or_is_said_to_be_returned_or_passed():
    returned = returned_by_public_functions()
    docstrings = " ".join(inspect.getdoc(thing) for name, thing in PUBLIC.items())
    for name, thing in PUBLIC.items():
        if inspect.isclass(thing) and "```python" not in inspect.getdoc(thing):
            assert re.search(rf"\b{name}\b", returned + docstrings), f"nothing tells where {name} comes from"


@pytest.mark.slow
def test_pydoc_shows_the_map_and_a_signature():
    for name, expected in (("lagjax", "`simulate`, `simulate_batch`"), ("lagjax.simulate", "The motion of `system`")):
        assert expected in pydoc.plain(pydoc.render_doc(name))


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("mkdocstrings") is None, reason="mkdocstrings is not installed")
def test_every_public_name_and_every_example_has_a_page(tmp_path):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert built.returncode == 0, built.stdout + built.stderr
    for name, thing in PUBLIC.items():
        page = (tmp_path / "reference" / f"{name}.html").read_text()
        shown = " ".join(re.sub(r"<[^>]*>", "", page).split())
        words = re.split(r"[`*<>&\"']", " ".join(inspect.getdoc(thing).split("\n\n")[0].split()))
        assert max(words, key=len).strip() in shown, f"the page of {name} lacks its summary"
    for path in (ROOT / "examples").glob("*.py"):
        page = (tmp_path / f"{path.stem}.html").read_text()
        assert f'href="{path.name}"' in page and (tmp_path / path.name).exists()
    # Nothing is asked of the net: no font, no script, no style, no picture from elsewhere.
    for page in tmp_path.rglob("*.html"):
        assert not re.search(
            r"<(?:script|img|link rel=\"stylesheet\")[^>]*(?:src|href)=\"(?:https?:)?//", page.read_text()
        )
        assert "<pre><span></span><a" not in page.read_text(), "output that begins with a name is no link"
