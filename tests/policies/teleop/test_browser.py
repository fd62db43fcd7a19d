"""The page: who may open it, what drives the robot, when it stops. Distances are judged, not times."""

import json
import re
import signal
import socket
import threading
import time
import urllib.error
import urllib.request
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from chromium import Chromium
from test_session import standing_view
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from arena_newton.data.recording.episode import EpisodeFile
from arena_newton.errors import InputError
from arena_newton.policies.protocols.ports import LOCAL, bind
from arena_newton.policies.teleop import __main__ as command
from arena_newton.policies.teleop.browser import DEAD_MAN, BrowserSource
from arena_newton.policies.teleop.driving import RANGES, Held
from arena_newton.policies.teleop.page_server import TAKEN_OVER, UNFIT, PageServer, new_token
from arena_newton.robot.canonical import ACTION
from arena_newton.robot.g1 import TICK
from tests.children import Child
from tests.patience import PLENTY, wait_for

FOREIGN = "http://evil.example"
"""A web site in another tab."""


@pytest.fixture
def server():
    """A page's server without a world."""
    made = PageServer(bind(0, "--port"), new_token(), {"task": "football", "ranges": RANGES})
    yield made
    made.close()


def fetch(url: str, **headers: str) -> tuple[int, bytes, dict]:
    """Status, body and headers of a GET."""
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=PLENTY) as answer:
            return answer.status, answer.read(), dict(answer.headers)
    except urllib.error.HTTPError as error:
        return error.code, error.read(), dict(error.headers)


def page_socket(server: PageServer, *, path: str | None = None, origin: str | None = None, **headers: str):
    """The socket as the page opens it."""
    url = (path or server.url).replace("http://", "ws://") + "socket"
    own = server.url.rsplit("/", 2)[0]
    return connect(url, origin=origin or own, additional_headers=headers, open_timeout=PLENTY, compression=None)


def test_the_page_needs_the_token(server):
    """The files are served under the token alone, to this machine's names alone, and no other site may frame them."""
    for name in ("", "page.css", "page.js"):
        status, body, headers = fetch(server.url + name)
        assert status == 200 and len(body) > 500
        assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]
    root = server.url.rsplit("/", 2)[0]
    token = server.url.split("/")[3]
    wrong = [
        "/",
        "/page.html",
        f"/{token[:-1]}/",
        f"/{'A' * len(token)}/page.js",
        f"/{token}/../session.py",
        f"/{token}/x",
    ]
    for path in (*wrong, f"/{token}/%2e%2e/browser.py", "/é/"):
        status, body, _ = fetch(root + urllib.request.quote(path))
        assert (status, body) == (404, b""), path
    assert fetch(server.url, Host="evil.example")[:2] == (404, b""), "a name that points here is not this machine"


@pytest.mark.parametrize(
    "change", [{"origin": FOREIGN}, {"origin": "null"}, {"path": "wrong"}, {"Host": "evil.example"}]
)
def test_the_socket_is_the_page_s_alone(server, change):
    """A foreign Origin or a wrong token opens no socket."""
    if change.get("path"):
        change = {"path": server.url.replace(server.url.split("/")[3], new_token())}
    with pytest.raises((InvalidStatus, ConnectionClosed)) as refused:
        page_socket(server, **change).recv(timeout=PLENTY)
    if isinstance(refused.value, InvalidStatus):
        assert refused.value.response.status_code in (403, 404)
    assert server.held()[1] == float("inf") and not server.connected


def test_what_is_held_arrives_and_grows_old(server):
    """A message is held and ages until the next; a closed socket holds nothing; events arrive once."""
    with page_socket(server) as page:
        assert json.loads(page.recv(timeout=PLENTY))["kind"] == "facts"
        page.send(json.dumps({"forward": 0.5, "events": ["start", "kick_left"]}))
        held, age = wait_for(lambda: server.held() if server.held()[0].forward else None, "message")
        assert held == Held(forward=0.5) and 0.0 <= age < PLENTY
        assert server.events() == ["start", "kick_left"] and server.events() == []
        time.sleep(0.05)
        assert server.held()[1] >= 0.05
        server.publish({"tick": 7}, np.zeros((24, 32, 3), np.uint8))
        answers = [page.recv(timeout=PLENTY) for _ in range(2)]
        assert json.loads(answers[0]) == {"kind": "state", "tick": 7} and answers[1][:2] == b"\xff\xd8"
    wait_for(lambda: server.held()[1] == float("inf"), "end of the page")


def test_the_newest_page_drives(server):
    """A second page takes over; the first one is notified and moves nothing any more."""
    with page_socket(server) as first:
        first.recv(timeout=PLENTY)
        with page_socket(server) as second:
            second.recv(timeout=PLENTY)
            with pytest.raises(ConnectionClosed) as closed:
                while True:
                    first.recv(timeout=PLENTY)
            assert closed.value.rcvd.code == TAKEN_OVER
            second.send('{"turn": 1}')
            wait_for(lambda: server.held()[0].turn == 1.0, "message")


def deaf_page(server: PageServer) -> socket.socket:
    """A page that opens its socket and then reads nothing."""
    page = socket.create_connection((LOCAL, server.port), timeout=PLENTY)
    page.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    host = f"{LOCAL}:{server.port}"
    head = f"GET /{server.url.split('/')[3]}/socket HTTP/1.1\r\nHost: {host}\r\nOrigin: http://{host}\r\n"
    head += "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
    page.sendall(f"{head}Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n".encode())
    wait_for(lambda: server.connected, "deaf page")
    return page


def fill(server: PageServer) -> None:
    """Send the page so much that it does not fit into what lies between."""
    note = "x" * 2**24
    server.publish({"tick": 1, "note": note}, None)
    time.sleep(0.1)


def test_a_page_that_reads_nothing_delays_nobody(server):
    """A page that has stopped reading is taken over at once, and holds up neither the next page nor the end."""
    with deaf_page(server):
        fill(server)
        server.publish({"tick": 2}, None)
        began = time.monotonic()
        with page_socket(server) as second:
            assert json.loads(second.recv(timeout=PLENTY))["kind"] == "facts"
            second.send('{"turn": 1}')
            wait_for(lambda: server.held()[0].turn == 1.0, "message of the second page")
        assert time.monotonic() - began < 8.0, "a socket whose page does not answer takes 10 s to close"
    with deaf_page(server):
        fill(server)
        ending = threading.Thread(target=server.close, daemon=True)
        ending.start()
        ending.join(PLENTY)
        assert not ending.is_alive()


def test_strangers_do_not_end_the_page(server):
    """A hundred idle connections are more than are taken, and the page is there when they have left."""
    idle = [socket.create_connection((LOCAL, server.port), timeout=PLENTY) for _ in range(100)]
    assert idle[-1].recv(1) == b"", "it is closed unread"
    for connection in idle:
        connection.close()

    def served() -> bool:
        with suppress(OSError):
            return fetch(server.url)[0] == 200
        return False

    wait_for(served, "page after the strangers")


def test_a_path_that_is_no_text_is_not_found(server):
    """Bytes that are no characters are a wrong token, and no fault of the server."""
    with socket.create_connection((LOCAL, server.port), timeout=PLENTY) as stranger:
        stranger.sendall(b"GET /\xff\xfe/ HTTP/1.1\r\nHost: 127.0.0.1:%d\r\n\r\n" % server.port)
        assert stranger.recv(100).startswith(b"HTTP/1.1 404 ")


@pytest.mark.parametrize("message", ["x", '{"forward": "fast"}', '{"x": 1}', b"\xff\x00", "[" + "1," * 5000 + "1]"])
def test_an_unfit_message_ends_the_page_alone(server, message):
    """A page that sends anything else loses its socket at worst; the next one is served."""
    with page_socket(server) as page:
        page.recv(timeout=PLENTY)
        page.send(message)
        with pytest.raises(ConnectionClosed) as closed:
            while True:
                page.recv(timeout=PLENTY)
        assert closed.value.rcvd.code in (UNFIT, 1009, 1007)
    wait_for(lambda: not server.connected, "end of the page")
    with page_socket(server) as page:
        assert json.loads(page.recv(timeout=PLENTY))["task"] == "football"


def test_a_taken_port_is_an_error(capsys):
    """Page and view name the port that is taken, before anything heavy is loaded; the exit code is 2."""
    with socket.create_server((LOCAL, 0)) as taken:
        port = taken.getsockname()[1]
        for flags in (["--port", str(port)], ["--port", "0", "--view-port", str(port)]):
            assert command.main(["browser", *flags]) == 2
            assert f"{flags[-2]} {port}: cannot be served" in capsys.readouterr().err
    with pytest.raises(InputError, match="no such port"):
        bind(70000, "--port")


@pytest.mark.parametrize(
    ("flags", "named"),
    [
        (["browser", "--task", "chess"], "--task chess"),
        (["browser", "--mode", "dark"], "--mode dark"),
        (["browser", "--variant", "none.usda"], "--variant none.usda"),
        (["browser", "--seed", "-1"], "--seed -1"),
        (["browser", "--ego-size", "9x9"], "--ego-size 9x9"),
        (["browser", "--speed", "9"], "--speed"),
        (["pigeon"], "pigeon"),
    ],
)
def test_wrong_flags_are_one_line(flags, named, capsys):
    """A wrong flag is named in one line, with exit code 2."""
    ports = ["--port", "0"] if flags[0] == "browser" else []
    assert command.main([*flags, *ports]) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith("error: ") and named in error


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    """A browser for all pages."""
    with Chromium(tmp_path_factory.mktemp("browser") / "profile") as page:
        yield page


@pytest.fixture
def page(browser, server):
    """The page of a server without a world."""
    browser.open(server.url)
    wait_for(lambda: server.held()[1] < PLENTY, "message of the page")
    return browser


def test_keys_and_stick_drive_and_leaving_the_window_lets_go(server, page):
    """Held keys and the dragged stick arrive as deflections; when released, or without focus, nothing is held."""

    def driven(forward=0, left=0, turn=0):
        def check() -> bool:
            held, _ = server.held()
            return tuple(np.sign([held.forward, held.left, held.turn])) == (forward, left, turn)

        wait_for(check, f"deflection {forward, left, turn}")

    for key, deflection in (("w", {"forward": 1}), ("a", {"left": 1}), ("e", {"turn": -1})):
        page.key(key, True)
        driven(**deflection)
        page.key(key, False)
        driven()
    x, y = page.value(
        "(({x,y,width,height}) => [x+width/2, y+height/2])(document.getElementById('stick').getBoundingClientRect())"
    )
    page.mouse("mousePressed", x, y)
    page.mouse("mouseMoved", x, y + 60)
    driven(forward=-1)
    page.mouse("mouseReleased", x, y + 60)
    driven()
    page.key("w", True)
    driven(forward=1)
    page.value("window.dispatchEvent(new Event('blur'))")
    driven()
    page.key("w", False)


def test_a_page_that_hangs_or_leaves_stops_the_robot(server, page):
    """No message for 0.3 s is nobody: with a page that hangs, and after one that goes, the actions come to a stand."""
    assert DEAD_MAN == 0.3
    source, view = BrowserSource(server), standing_view()
    source.begin(view)

    def speed() -> float:
        walked = [source.wish(view).action[ACTION["root_xy_delta"]] for _ in range(30)]
        return float(np.linalg.norm(walked, axis=1).max()) / TICK

    page.key("w", True)
    wait_for(lambda: speed() > 0.4, "walk")
    page.call("Debugger.enable")
    page.call("Debugger.pause")
    wait_for(lambda: speed() < 0.01, "stand while the page hangs")
    assert server.connected and server.held()[0].forward == 1.0, "its socket is open and the key held"
    page.call("Debugger.resume")
    page.call("Debugger.disable")
    wait_for(lambda: speed() > 0.4, "walk of the page that is back")
    page.open("about:blank")
    wait_for(lambda: speed() < 0.01, "stand without a page")
    assert not server.connected


class Session:
    """The command in a process of its own."""

    def __init__(self, folder: Path, *flags: str):
        arguments = ["browser", "--task", "football", "--port", "0", "--out", str(folder / "saved"), *flags]
        self.process = Child("arena_newton.policies.teleop.__main__", arguments)

    @property
    def url(self) -> str:
        """Address of the page."""

        def look() -> str | None:
            said, complaints = self.process.printed()
            if self.process.poll() is not None:
                pytest.fail(f"the session ended:\n{said}{complaints}", pytrace=False)
            found = re.search(r"open (http://\S+)", said)
            return found and found[1]

        return wait_for(look, "address in the log")

    def end(self) -> str:
        """Ctrl-C; its messages."""
        self.process.send_signal(signal.SIGINT)
        return "".join(self.process.communicate(PLENTY))


@pytest.fixture(scope="module")
def running(browser, tmp_path_factory):
    """A session with a world's view, and a page that is open."""
    folder = tmp_path_factory.mktemp("session")
    one = Session(folder, "--ego-size", "64x48")
    try:
        browser.open(one.url)
        browser.wait("Number(document.body?.dataset.tick) > 0", "world that runs")
        yield one, browser, folder / "saved"
    finally:
        one.end()


def place(page: Chromium) -> np.ndarray:
    """Position of the robot [m]."""
    return np.array(str(page.value("document.body.dataset.position")).split(), dtype=float)


def still(page: Chromium) -> np.ndarray:
    """Wait until the robot stands, and say where."""
    before = [place(page), int(page.value("Number(document.body.dataset.tick)"))]

    def check() -> bool:
        tick, now = int(page.value("Number(document.body.dataset.tick)")), place(page)
        if tick - before[1] < 15:
            return False
        stands = bool(np.linalg.norm(now - before[0]) < 0.01)
        before[:] = [now, tick]
        return stands

    wait_for(check, "robot that stands")
    return before[0]


def test_the_page_shows_the_world(running):
    """Task, head camera, state and the view arrive; viser's socket opens for its own page with the token alone."""
    _, page, _ = running
    assert "football" in str(page.value("document.getElementById('task').textContent"))
    frame = str(page.value("document.getElementById('frame').src"))
    # A browser that draws the world without a GPU takes more time than all the rest.
    page.value("document.getElementById('frame').src = 'about:blank'")
    page.wait("document.getElementById('picture').naturalWidth == 64", "picture of the head camera")
    page.wait("document.getElementById('driven').textContent == 'you drive'", "page that drives")
    own, inner = re.match(r"(http://[^/]+)/\?websocket=(ws://127.0.0.1\S+)", frame).groups()
    options = {"subprotocols": ["viser-v1.1.1"], "open_timeout": PLENTY}
    with connect(inner, origin=own, **options):
        pass
    for url, origin in ((inner, FOREIGN), (inner.rsplit("/", 1)[0], own), (inner[:-3] + "abc", own)):
        with pytest.raises(InvalidStatus):
            connect(url, origin=origin, **options)


def test_a_recorded_walk_is_saved(running):
    """The robot walks ahead while `w` is held, to its left with `a`, and stands then; saved, it is an episode."""
    one, page, folder = running
    page.value("document.getElementById('record').click()")
    page.wait("document.body.dataset.recording == 'recording' && Number(document.body.dataset.tick) > 0", "recording")
    moved, at = {}, place(page)
    for key, metres in (("w", 0.2), ("a", 0.1)):
        start = at
        page.key(key, True)
        wait_for(lambda start=start, far=metres: np.linalg.norm((place(page) - start)[:2]) > far, f"walk of {metres} m")
        page.key(key, False)
        at = still(page)
        moved[key] = at - start
    assert moved["w"][1] > 0.2 and abs(moved["w"][0]) < 0.5 * moved["w"][1], "football faces along y"
    assert moved["a"][0] < -0.08 and abs(moved["a"][1]) < -moved["a"][0]
    page.value("document.getElementById('save').click()")
    page.wait("document.body.dataset.recording == 'saved'", "saved episode")
    (file,) = folder.glob("*.npz")
    assert file.name in str(page.value("document.getElementById('note').textContent"))
    episode = EpisodeFile(file)
    position = episode.array("robot_root_position")
    assert np.linalg.norm(position[-1, :2] - position[0, :2]) > 0.2
    assert episode.text("arena_policy") == "teleop-browser"


def test_the_end_says_how_real_the_time_was(running):
    """Ctrl-C ends the session with exit code 0 and one line: real-time factor, late ticks, pictures, episodes."""
    one, _, folder = running
    said = one.end()
    assert one.process.returncode == 0, said
    saved = len(list(folder.glob("*.npz")))
    pattern = (
        rf"real-time factor [01]\.\d+; \d+ of \d+ ticks late .*; \d+ pictures, \d+ put off; {saved} episodes? saved"
    )
    assert re.search(pattern, said), said
