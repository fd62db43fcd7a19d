"""A policy server to start from: it stands, with noise that follows from seed and step alone. A model goes into `act`.

python -m arena_newton.policies.serve_example 8443
"""

import argparse
import base64
import json
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np

from arena_newton.robot.canonical import STAND_ACTION


def act(image: np.ndarray, state: np.ndarray, instruction: str, rng: np.random.Generator) -> np.ndarray:
    """The model: picture uint8 [480, 640, 3], state [64], text and noise → actions [n, 40], here 0.4 s of standing."""
    actions = np.tile(STAND_ACTION, (20, 1))
    actions[:, 9:38] += 0.01 * rng.standard_normal(29)
    return actions


class Handler(BaseHTTPRequestHandler):
    """One connection of the client, which keeps one for each world."""

    protocol_version, disable_nagle_algorithm = "HTTP/1.1", True

    def do_POST(self) -> None:  # noqa: N802 (the name that http.server calls)
        """Answer /reset and /infer."""
        asked = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        reply = {"ok": True, "seeded": True, "policy": "standing with noise"}
        if self.path == "/infer":
            seen, front = asked["observation"], asked["observation"]["images"]["front"]
            image = np.frombuffer(base64.b64decode(front["data_b64"]), np.uint8).reshape(front["shape"])
            rng = np.random.default_rng([asked["seed"], asked["step"]])
            reply = {"action_chunk": act(image, np.array(seen["state"]), asked["instruction"], rng).tolist()}
        data = json.dumps(reply).encode()
        self.send_response(200)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)


class Server(ThreadingHTTPServer):
    """A thread for each connection; the queue holds the connections of all worlds, which come at once."""

    request_queue_size, daemon_threads = 128, True


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Answer queries of a policy at this TCP port.")
    parser.add_argument("port", type=int)
    Server(("127.0.0.1", parser.parse_args().port), Handler).serve_forever()
