"""A policy server in a thread of the test: JSON in and out."""

import json
import threading
from http.server import BaseHTTPRequestHandler

from arena_newton.policies.serve_example import Server


class JsonHandler(BaseHTTPRequestHandler):
    """One connection, which is kept."""

    protocol_version, disable_nagle_algorithm = "HTTP/1.1", True

    def asked(self):
        """Content of the request."""
        return json.loads(self.rfile.read(int(self.headers["Content-Length"])))

    def answer(self, status, content):
        """Send JSON, or bytes as they are."""
        data = content if isinstance(content, bytes) else json.dumps(content).encode()
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, *_):
        pass


class JsonServer(Server):
    """Serves at a free port until it is closed; its handlers read what a test sets on it."""

    def __init__(self, handler, **given):
        super().__init__(("127.0.0.1", 0), handler)
        self.lock, self.url = threading.Lock(), f"http://127.0.0.1:{self.server_port}"
        vars(self).update(given)
        self.thread = threading.Thread(target=self.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
        self.thread.start()

    def close(self):
        if self.thread.is_alive():
            self.shutdown()
        self.server_close()
