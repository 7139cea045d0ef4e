"""The playground: what its cells compute, that a new value compiles nothing, and its page in a browser."""

import base64
import importlib
import importlib.util
import json
import re
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path

import jax
import numpy as np
import pytest

PAGE = Path(__file__).parents[2] / "examples" / "playground.py"
# All text of the page, also inside of the elements that marimo draws, which are documents of their own.
TEXT = """(function all(node) {
  return [...node.childNodes].map(n => n.nodeType == 3 ? n.data
    : ["STYLE", "SCRIPT"].includes(n.tagName) ? "" : all(n.shadowRoot ?? n)).join(" ");
})(document.body)"""
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(importlib.util.find_spec("marimo") is None, reason="marimo is not installed"),
]


@pytest.fixture(scope="module")
def cells():
    spec = importlib.util.spec_from_file_location("playground", PAGE)
    page = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(page)
    return page.app.run()[1]


def test_what_the_page_shows(cells):
    assert np.ptp(cells["energy"]) < 1e-5 and bool(cells["trajectory"].ok.all())
    assert 0 < cells["flip"] < 20 and 0.5 < cells["growth"] < 10
    # Low swings neither flip nor diverge, and friction takes energy.
    numbers = {"l1": 1.0, "l2": 0.8, "m1": 1.0, "m2": 1.0, "friction": 0.1}
    low = cells["motion"](numbers, [0.3, 0.2])
    q, energy = np.asarray(low.q), np.asarray(low.energy())[0]
    assert cells["first_flip"](q[0]) is None and cells["divergence"](q)[1] is None
    assert (np.diff(energy) < 1e-9).all() and energy[-1] < energy[0] - 0.1


def test_a_new_value_compiles_nothing(cells):
    numbers = {"l1": 1.0, "l2": 0.8, "m1": 1.0, "m2": 1.0, "friction": 0.0}
    cells["motion"](numbers, [1.0, 2.0])
    compiled = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, duration, **_: compiled.append(event) if "backend_compile" in event else None
    )
    for k, name in enumerate(numbers):
        cells["motion"](numbers | {name: 0.1 + 0.2 * k}, [0.1 * k, 2.0])
    assert not compiled


@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium")
def test_the_page_in_a_browser(tmp_path):
    matplotlib = pytest.importorskip("matplotlib.image")
    sync = pytest.importorskip("websockets.sync.client")
    port = _free_port()
    command = [sys.executable, "-m", "marimo", "run", str(PAGE), "--headless", "--no-token", "--host", "127.0.0.1"]
    server = subprocess.Popen([*command, "--port", str(port)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        _until(lambda: urllib.request.urlopen(f"http://127.0.0.1:{port}", timeout=5).status == 200)
        text = _screenshot(sync, f"http://127.0.0.1:{port}", tmp_path / "page.png")
    finally:
        server.terminate()
        server.wait(20)
    assert re.search(r"\d+ ms", text) and "first flip" in text and "friction" in text and "Traceback" not in text
    picture = matplotlib.imread(tmp_path / "page.png")[..., :3]
    # The curves in the colours of Okabe and Ito are there, to the right of the sliders.
    for color in ("0072B2", "D55E00", "009E73", "CC79A7"):
        rgb = np.frombuffer(bytes.fromhex(color), np.uint8) / 255
        assert (np.abs(picture[:, picture.shape[1] // 4 :] - rgb).max(axis=2) < 0.03).sum() > 100, f"no {color}"


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def _until(ready, seconds: float = 40.0):
    end = time.monotonic() + seconds
    while True:
        try:
            if result := ready():
                return result
        except OSError:
            pass
        assert time.monotonic() < end, "it did not come up"
        time.sleep(0.3)


def _screenshot(sync, address: str, path: Path) -> str:
    """The text of a page once the motion is there, and its picture at `path`, by Chromium's own protocol."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:  # its processes may end after it
        command = [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--window-size=1700,1000"]
        command += [f"--user-data-dir={profile}", "--remote-debugging-port=0", address]
        browser = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            chosen = Path(profile) / "DevToolsActivePort"
            port = _until(lambda: chosen.exists() and chosen.read_text().split()[:1])[0]
            tabs = json.load(urllib.request.urlopen(f"http://127.0.0.1:{port}/json"))
            page = next(tab for tab in tabs if tab["type"] == "page")
            with sync.connect(page["webSocketDebuggerUrl"], max_size=None) as devtools:

                def ask(method, **parameters):
                    devtools.send(json.dumps({"id": 1, "method": method, "params": parameters}))
                    while "id" not in (answer := json.loads(devtools.recv(timeout=60))):
                        pass
                    return answer["result"]

                def text():
                    return ask("Runtime.evaluate", expression=TEXT)["result"].get("value", "")

                _until(lambda: "first flip" in text())
                time.sleep(4.0)  # the sliders and the figure are drawn, and the pendulum swings
                path.write_bytes(base64.b64decode(ask("Page.captureScreenshot")["data"]))
                return text()
        finally:
            browser.terminate()
            browser.wait(20)
