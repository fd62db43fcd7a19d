"""Policy servers of every protocol, in threads: they answer what follows from state, picture, seed and step, or fail.

`behave` maps the first number of a state to a fault, so that a test chooses the world whose request fails.
"""

import base64
import dataclasses
import io
import json
import threading
import time

import msgpack
import numpy as np
import torch
import zmq
from json_server import JsonHandler, JsonServer
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import serve

from arena_newton import policies
from arena_newton.data.readers.label_protocols import action_names
from arena_newton.data.recording.layouts import state_names
from arena_newton.pictures.camera import CameraConfig
from arena_newton.policies import Chunk, Observation, Policy, world_mask
from arena_newton.policies.protocols import openpi_codec, vla_eval_codec
from arena_newton.policies.protocols.handshake import ServedFacts, ServedPicture
from arena_newton.policies.protocols.packed_arrays import OPENPI_KEYS, pack
from arena_newton.policies.protocols.packed_picture import PackedPicture
from arena_newton.policies.protocols.policy_messages import Begin, End
from arena_newton.robot.canonical import ACTION, STAND_ACTION

CHUNK = 4
SIZE = 64
"""Width and height of the pictures that declared servers want [px]."""
TRACEBACK = (
    'Traceback (most recent call last):\n  File "server.py", line 7, in infer\nRuntimeError: CUDA out of memory\n'
)


def facts(**other):
    """Declaration of a server of ours."""
    names = tuple(action_names(other.get("labels", "v3.1")))
    said = {
        "policy": "noise 1",
        "labels": "v3.1",
        "action_names": names,
        "state_names": tuple(state_names()),
        "chunk_length": CHUNK,
        "rate_hz": 50.0,
        "needs_picture": True,
        "picture": ServedPicture(SIZE, SIZE),
        "seeded": True,
    }
    return ServedFacts(**(said | other))


def answer(state, image, seed, step):
    """Actions of one world: noise from seed and step, what the state says, and how bright the picture is."""
    rng = np.random.default_rng([seed or 0, step or 0])
    actions = np.tile(STAND_ACTION, (CHUNK, 1)).astype(np.float64)
    bright = 0.0 if image is None else float(np.asarray(image, np.int64).sum() % 1009) / 1009.0
    actions[:, 9:38] += 0.05 * np.sin(10.0 * np.asarray(state, np.float64)[6:35]) + 0.02 * bright
    actions[:, 9:38] += 0.05 * rng.standard_normal((CHUNK, 29))
    return actions.astype(np.float32)


class NoisePolicy(Policy):
    """The same in this process."""

    name, labels, needs_image, chunk_size = "noise", "v3.1", True, CHUNK

    def __init__(self):
        self.camera = facts_camera()
        self.seeds, self.steps = {}, {}

    def reset(self, seeds, tasks, mask=None):
        for world in np.flatnonzero(world_mask(mask, len(seeds))):
            self.seeds[int(world)], self.steps[int(world)] = int(seeds[world]), 0

    def act(self, observation):
        state = np.asarray(observation.state)
        chunk = np.tile(STAND_ACTION, (len(state), CHUNK, 1))
        for world in np.flatnonzero(observation.mask):
            w = int(world)
            image = None if observation.image is None else np.asarray(observation.image[w])
            chunk[w] = answer(state[w], image, self.seeds.get(w), self.steps.get(w, 0))
            self.steps[w] = self.steps.get(w, 0) + CHUNK
        return Chunk(chunk)


def facts_camera():
    """The picture that declared servers want."""
    return CameraConfig(width=SIZE, height=SIZE)


def observation(worlds, mask=None, size=SIZE):
    """Worlds whose states begin with their numbers, with pictures that differ."""
    state = torch.zeros(worlds, 64)
    state[:, 0] = torch.arange(worlds)
    picture = torch.arange(worlds, dtype=torch.uint8)[:, None, None, None].expand(worlds, size, size, 3)
    mask = np.ones(worlds, bool) if mask is None else np.asarray(mask)
    return Observation(state, picture, mask, "football", "Isaac-Football", "Kick the ball.")


OPENED = []
"""Servers and policies of a test; the fixture `closed` closes them after it."""


def asking(url, **options):
    """The policy that asks a server."""
    OPENED.append(policies.get(f"remote:{url}", **options))
    return OPENED[-1]


class Recorder:
    """Memory of a server, and the faults that it is given."""

    def __init__(self):
        OPENED.append(self)
        self.lock, self.release = threading.Lock(), threading.Event()
        self.behave, self.seen, self.tokens, self.live = {}, [], [], []
        self.connections = 0

    def note(self, kind, content):
        with self.lock:
            self.seen.append((kind, content))

    def fault(self, query):
        return self.behave.get(float(query.state[0]), self.behave.get("any", ""))


class SocketServer(Recorder):
    """openpi's, RoboArena's or vla-eval's server."""

    def __init__(self, protocol, declared=None, port=0, metadata=None, config=None, ssl=None):
        super().__init__()
        self.protocol, self.declared, self.metadata, self.config = protocol, declared, metadata, config
        talk = {"openpi": self.openpi, "roboarena": self.openpi, "vla-eval": self.vla_eval}[protocol]
        self.server = serve(
            lambda socket: self.handle(socket, talk),
            "127.0.0.1",
            port,
            compression=None,
            max_size=None,
            process_request=self.page,
            ssl=ssl,
        )
        self.port = self.server.socket.getsockname()[1]
        self.url = f"{protocol}://127.0.0.1:{self.port}"
        threading.Thread(target=self.server.serve_forever, daemon=True).start()

    def page(self, connection, request):
        self.tokens.append(request.headers.get("Authorization"))
        if request.path == "/config":
            body = json.dumps(self.config.to_json() if self.config else {})
            return connection.respond(200 if self.config else 404, body)
        return None

    def handle(self, socket, talk):
        with self.lock:
            self.live.append(socket)
            self.connections += 1
        try:
            talk(socket)
        except (ConnectionClosed, OSError):
            pass

    def openpi(self, socket):
        if self.metadata is not None:
            first = self.metadata if isinstance(self.metadata, bytes | str) else pack(self.metadata, OPENPI_KEYS)
        else:
            first = openpi_codec.pack_metadata(self.declared or ServedFacts(), roboarena=self.protocol == "roboarena")
            first = first if self.declared or self.protocol == "roboarena" else pack({}, OPENPI_KEYS)
        socket.send(first)
        known = {}
        for data in socket:
            request, _ = openpi_codec.unpack_request(data)
            if isinstance(request, Begin):
                self.note("reset", request)
                known[request.session] = request.seed
                bad = self.behave.get("reset")
                socket.send(TRACEBACK if bad else openpi_codec.RESET_ANSWER)
                if bad:
                    socket.close(1011, "Internal server error.")
                    return
                continue
            self.note("query", request)
            if not self.fail(socket, request):
                seed = known.get(request.session) if request.seed is None else request.seed
                rows = answer(request.state, request.image, seed, request.step)
                socket.send(openpi_codec.pack_answer(rows, 1.0, roboarena=self.protocol == "roboarena"))

    def fail(self, socket, query):
        """Fail as `behave` says; whether it did."""
        kind = self.fault(query)
        good = answer(query.state, query.image, 0, 0)
        wrong = {
            "39": good[:, :39],
            "nan": np.where(np.arange(40) == 20, np.nan, good).astype(np.float32),
            "flat": good.reshape(-1),
            "none": good[:0],
            "long": np.tile(good, (1100, 1)),
            "words": np.array([1, 2, 3]),
        }
        if kind in wrong:
            socket.send(self.pack(wrong[kind]))
        elif kind == "slow":
            self.release.wait(600.0)
        elif kind == "text":
            socket.send(TRACEBACK)
            socket.close(1011, "Internal server error. Traceback included in previous frame.")
        elif kind == "unknown":
            socket.send("unknown episode")
        elif kind == "escapes":
            socket.send("\x1b[31mred\x1b[0m \x1b]0;title\x07" + self.tokens[-1].split()[-1] + "\n")
        elif kind == "garbage":
            socket.send(b"\xc1\xff\x00" * 40)
        elif kind == "oversize":
            socket.send(b"\x00" * (5 << 20))
        elif kind == "twice":
            socket.send(self.pack(good))
            socket.send(self.pack(good * 0 + 7))
        elif kind == "hangs up":
            socket.close_socket()
        elif kind == "closes":
            socket.close(1013, "come again")
        elif kind == "dies":
            self.kill()
        else:
            return False
        return True

    def pack(self, rows):
        return pack({"actions": rows, "server_timing": {"infer_ms": 1.0}}, OPENPI_KEYS)

    def vla_eval(self, socket):
        known = {}
        for data in socket:
            message = vla_eval_codec.unpack_message(data)
            if message.type == "hello":
                if self.metadata is not None:
                    payload = {"harness_version": "0.8", "protocol_version": 1, **self.metadata}
                    socket.send(vla_eval_codec.pack_message("hello", payload, message.seq, time.time()))
                else:
                    socket.send(vla_eval_codec.pack_hello(self.declared, message.seq, time.time()))
                continue
            request = vla_eval_codec.unpack_request(message)
            if isinstance(request, Begin):
                self.note("reset", request)
                known[request.session] = request.seed
                if self.behave.get("reset"):
                    socket.send(vla_eval_codec.pack_error("episode_start_failed: no such task", message.seq, 0.0))
                continue
            if isinstance(request, End):
                self.note("end", request)
                continue
            shown = request.images.items()
            unpacked = {name: one.unpacked() if isinstance(one, PackedPicture) else one for name, one in shown}
            request = dataclasses.replace(request, images=unpacked)
            self.note("query", request)
            kind = self.fault(request)
            if kind == "text":
                socket.send(vla_eval_codec.pack_error("RuntimeError: CUDA out of memory", message.seq, 0.0))
            elif kind == "unknown":
                socket.send(vla_eval_codec.pack_error("unknown episode", message.seq, 0.0))
            elif kind == "late":
                rows = answer(request.state, request.image, 0, 0)
                socket.send(vla_eval_codec.pack_action(rows, message.seq - 1, 0.0))
            elif kind == "hello":
                socket.send(vla_eval_codec.pack_hello(None, message.seq, 0.0))
            elif kind in ("39", "nan", "flat", "none", "long", "words", "twice"):
                self.pack = lambda rows, seq=message.seq: vla_eval_codec.pack_action(rows, seq, 0.0)
                self.fail(socket, request)
            elif not self.fail(socket, request):
                rows = answer(request.state, request.image, request.seed, request.step)
                socket.send(vla_eval_codec.pack_action(rows, message.seq, time.time()))

    def kill(self):
        """End the server as a killed process does."""
        self.server.shutdown()
        for socket in list(self.live):
            socket.close_socket()

    def close(self):
        self.release.set()
        self.kill()


MODALITIES = {
    "video": {"delta_indices": [0], "modality_keys": ["ego_view"]},
    "state": {"delta_indices": [0], "modality_keys": ["root_rot6d", "joint_pos", "joint_vel"]},
    "action": {"delta_indices": list(range(CHUNK)), "modality_keys": list(ACTION)},
    "language": {"delta_indices": [0], "modality_keys": ["annotation.human.task_description"]},
}
"""Declaration of a GR00T server that was trained on our data."""


def npy(array):
    """An array as GR00T writes it."""
    file = io.BytesIO()
    np.save(file, array, allow_pickle=False)
    return {"__ndarray_class__": True, "as_npy": file.getvalue()}


def gr00t_packed(content):
    """A message written by msgpack itself, as GR00T's server does."""
    return msgpack.packb(content, default=lambda item: npy(item) if isinstance(item, np.ndarray) else item)


def gr00t_unpacked(data):
    """A message read by msgpack itself."""

    def array(item):
        return np.load(io.BytesIO(item["as_npy"]), allow_pickle=False) if "__ndarray_class__" in item else item

    return msgpack.unpackb(data, object_hook=array)


class Gr00tServer(Recorder):
    """GR00T's server: a ZMQ socket that answers one request after another."""

    def __init__(self, modalities=None, declared=None, port=0, token=None):
        super().__init__()
        self.modalities, self.declared, self.token = modalities or MODALITIES, declared, token
        self.context = zmq.Context()
        self.socket = self.context.socket(zmq.REP)
        self.socket.setsockopt(zmq.LINGER, 0)
        self.socket.bind(f"tcp://127.0.0.1:{port}" if port else "tcp://127.0.0.1:*")
        self.port = int(self.socket.getsockopt_string(zmq.LAST_ENDPOINT).rpartition(":")[2])
        self.url, self.running = f"gr00t://127.0.0.1:{self.port}", True
        self.thread = threading.Thread(target=self.serve, daemon=True)
        self.thread.start()

    def serve(self):
        while self.running:
            if self.socket.poll(20):
                request = gr00t_unpacked(self.socket.recv())
                reply = self.reply(request)
                if self.running:
                    self.socket.send(reply if isinstance(reply, bytes) else gr00t_packed(reply))
        self.socket.close(linger=0)
        self.context.term()

    def reply(self, request):
        if self.token is not None and request.get("api_token") != self.token:
            return {"error": "Unauthorized: Invalid API token"}
        endpoint = request["endpoint"]
        self.note(endpoint, request.get("data"))
        if endpoint == "ping":
            return {
                "status": "ok",
                "message": "Server is running",
                **(self.declared.to_json() if self.declared else {}),
            }
        if endpoint == "get_modality_config":
            return {
                name: {"__ModalityConfig_class__": True, "as_json": config} for name, config in self.modalities.items()
            }
        if endpoint == "reset":
            return {"error": "no episode"} if self.behave.get("reset") else {}
        return self.actions(request["data"])

    def actions(self, data):
        seen, options = data["observation"], data["options"] or {}
        state = np.concatenate([seen["state"][name] for name in self.modalities["state"]["modality_keys"]], axis=-1)
        names = self.modalities["video"]["modality_keys"]
        video = seen["video"][names[0]] if names else [[None]] * len(state)
        rows = [
            answer(state[i, 0], video[i][0], options.get("seed", [0] * 99)[i], options.get("step", [0] * 99)[i])
            for i in range(len(state))
        ]
        faults = [self.behave.get(float(state[i, 0, 0]), self.behave.get("any", "")) for i in range(len(state))]
        chunk = np.stack(rows)
        for i, kind in enumerate(faults):
            if kind == "nan":
                chunk[i, :, 20] = np.nan
        kind = next((kind for kind in faults if kind and kind != "nan"), "")
        if kind == "slow":
            self.release.wait(600.0)
        if kind == "text":
            return {"error": "CUDA out of\nmemory"}
        if kind == "ERROR":
            return b"ERROR"
        if kind == "garbage":
            return b"\xc1\xff" * 40
        if kind == "oversize":
            return b"\x00" * (5 << 20)
        if kind == "objects":
            file = io.BytesIO()
            np.save(file, np.array([{}]), allow_pickle=True)
            return [{"root_z": {"__ndarray_class__": True, "as_npy": file.getvalue()}}, {}]
        if kind == "dies":
            self.running = False
        keys = self.modalities["action"]["modality_keys"]
        if len(keys) == 1:
            return [{keys[0]: chunk}, {}]
        parts = {name: chunk[..., ACTION[name]] for name in keys}
        if kind == "39":
            parts["joint_pos"] = parts["joint_pos"][..., 1:]
        if kind == "missing":
            del parts["hands"]
        return [parts, {}]

    def kill(self):
        self.running = False
        self.release.set()
        self.thread.join(60.0)

    close = kill


class HttpServer(Recorder):
    """The original's server, with what ours declares under `/config`."""

    def __init__(self, declared=None):
        super().__init__()
        outer = self

        class Handler(JsonHandler):
            def do_GET(self):  # noqa: N802 (the name that http.server calls)
                self.answer(200 if declared else 404, declared.to_json() if declared else {"error": "no such route"})

            def do_POST(self):  # noqa: N802 (the name that http.server calls)
                asked = self.asked()
                if self.path == "/reset":
                    self.answer(200, {"ok": True, "seeded": True, "policy": "noise 1"})
                    return
                front = asked["observation"]["images"]["front"]
                image = np.frombuffer(base64.b64decode(front["data_b64"]), np.uint8).reshape(front["shape"])
                outer.note("query", image.shape)
                if outer.behave.get("any") == "unknown":
                    self.answer(409, {"error": "unknown episode"})
                    return
                state = np.array(asked["observation"]["state"], np.float32)
                self.answer(200, {"action_chunk": answer(state, image, asked["seed"], asked["step"]).tolist()})

        server = JsonServer(Handler)
        self.url, self.close = server.url, server.close


def declared_servers():
    """One server of each protocol that declares itself, by name."""
    said = facts()
    return {
        "http": lambda: HttpServer(said),
        "openpi": lambda: SocketServer("openpi", said),
        "roboarena": lambda: SocketServer("roboarena", said, config=said),
        "vla-eval": lambda: SocketServer("vla-eval", said),
        "gr00t": lambda: Gr00tServer(declared=said),
    }
