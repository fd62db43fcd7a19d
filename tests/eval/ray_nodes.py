"""Machines of a Ray cluster, all on this one, for tests; and what ends their processes with `kill -9`."""

import os
import secrets
import signal
import socket
import subprocess
import sys
from pathlib import Path

import psutil

RAY = str(Path(sys.executable).with_name("ray"))


def free_port():
    """A port that nobody uses now."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


class Nodes:
    """A cluster whose machines are processes."""

    def __init__(self, log, environment=None, cores=1, gpus=0):
        """Start the head."""
        self.log = open(log, "ab")
        self.token = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
        """Environment of who may use the cluster."""
        self.environment = os.environ | {"RAY_USAGE_STATS_ENABLED": "0"} | self.token | (environment or {})
        self.address = f"127.0.0.1:{free_port()}"
        port = self.address.split(":")[1]
        flags = ["--head", "--port", port, "--include-dashboard=false", "--num-gpus", str(gpus)]
        self.head, self.others = self._start(*flags, cores=cores), []

    def add(self, cores=1):
        """One more machine."""
        self.others.append(self._start("--address", self.address, cores=cores))

    def _start(self, *flags, cores):
        command = [RAY, "start", *flags, "--block", "--node-ip-address", "127.0.0.1", "--num-cpus", str(cores)]
        command += ["--object-store-memory", str(80 << 20), "--disable-usage-stats"]
        return subprocess.Popen(command, env=self.environment, stdout=self.log, stderr=self.log, start_new_session=True)

    def actors(self):
        """Process ids of what plays."""
        return [pid for machine in (self.head, *self.others) for pid in actors(machine.pid)]

    def kill_machine(self, number):
        """All processes of a machine that is not the head, at once."""
        kill_all(self.others.pop(number))

    def stop(self):
        """End what is left."""
        for machine in (*self.others, self.head):
            kill_all(machine)
        self.log.close()


def descendants(pid):
    """Processes below one, as far as they are known."""
    try:
        return psutil.Process(pid).children(recursive=True)
    except psutil.Error:
        return []


def actors(pid):
    """Process ids of what plays, below a process."""
    found = []
    for process in descendants(pid):
        try:
            if process.name().startswith("ray::RayActor"):
                found.append(process.pid)
        except psutil.Error:
            continue
    return found


def kill_all(machine):
    """`kill -9` for a process and all below it."""
    below = descendants(machine.pid)
    machine.kill()
    for process in below:
        try:
            process.send_signal(signal.SIGKILL)
        except psutil.Error:
            continue
    machine.wait()
