"""Headless Chromium under its DevTools protocol: enough to open a page, press keys and look at it."""

import base64
import contextlib
import json
import os
import shutil
import signal
import subprocess
import urllib.request
from pathlib import Path

import pytest
from websockets.sync.client import connect

from tests.patience import PLENTY, wait_for


class Chromium:
    """One page in a browser of its own; a context."""

    def __init__(self, folder: Path, size: tuple[int, int] = (1400, 900), webgl: bool = False):
        program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
        if program is None:
            pytest.skip("needs a browser: apt-get install chromium")
        flags = [
            "--headless=new",
            "--no-sandbox",
            "--disable-dev-shm-usage",
            "--remote-debugging-port=0",
            "--mute-audio",
        ]
        flags += ["--no-first-run", "--disable-extensions", f"--user-data-dir={folder}"]
        flags += [f"--window-size={size[0]},{size[1]}"]
        flags += ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"] if webgl else ["--disable-gpu"]
        self.process = subprocess.Popen(
            [program, *flags, "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        self._number = 0
        try:
            port = wait_for(lambda: _port(folder), "Chromium's port")
            pages = json.load(urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=PLENTY))
            page = next(p for p in pages if p["type"] == "page")
            self._socket = connect(page["webSocketDebuggerUrl"], max_size=2**26, compression=None, open_timeout=PLENTY)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> "Chromium":
        return self

    def __exit__(self, *exception: object) -> None:
        self._socket.close()
        self.close()

    def close(self) -> None:
        """End the browser and its processes."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()

    def call(self, method: str, **parameters: object) -> dict:
        """One command of the protocol and its answer."""
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv(timeout=PLENTY))
            if answer.get("id") == self._number:
                assert "error" not in answer, answer
                return answer["result"]

    def open(self, url: str) -> None:
        """Go to a page."""
        self.call("Page.navigate", url=url)

    def value(self, expression: str) -> object:
        """Value of a JavaScript expression."""
        answer = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def wait(self, expression: str, what: str) -> object:
        """Wait until an expression is true."""
        return wait_for(lambda: self.value(expression), what)

    def key(self, key: str, down: bool) -> None:
        """Press or release a key of a letter."""
        kind = "keyDown" if down else "keyUp"
        code = {"windowsVirtualKeyCode": ord(key.upper()), "code": f"Key{key.upper()}", "key": key}
        self.call("Input.dispatchKeyEvent", type=kind, **({"text": key} if down else {}), **code)

    def mouse(self, kind: str, x: float, y: float) -> None:
        """`mousePressed`, `mouseMoved` or `mouseReleased` with the left button."""
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)

    def picture(self, path: Path) -> None:
        """Save what the page looks like."""
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"]))


def _port(folder: Path) -> str | None:
    file = folder / "DevToolsActivePort"
    lines = file.read_text().splitlines() if file.is_file() else []
    return lines[0] if len(lines) > 1 else None
