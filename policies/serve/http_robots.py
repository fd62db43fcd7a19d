"""Robots behind the requests of the original's HTTP protocol, which does not name them.

A client names itself by the header `X-Arena-Client`: its robots are those of its worlds and seeds, over any connection.
The original's client names neither itself nor a world. Then a robot belongs to the connection on which its episode
began, so that two clients which each keep a connection are two robots. A request on another connection is of a robot
whose connection has closed, the latest one; clients that open a connection for each request are one robot at an
address.
"""

from __future__ import annotations

import itertools
import select
import socket
import threading
from collections import OrderedDict, deque
from dataclasses import dataclass, field

import numpy as np

from arena_newton.policies.protocols.arena_codec import CLIENT_HEADER
from arena_newton.policies.serve.policy_server import Refused

__all__ = ["HttpRobot", "HttpRobots"]

MOST_WORLDS = 4096
"""Most worlds whose robots are remembered."""
MOST_ROBOTS = 256
"""Most robots of one world, address and client that are remembered."""
_HUNG_UP = getattr(select, "POLLRDHUP", select.POLLHUP)


@dataclass(eq=False)
class HttpRobot:
    """One robot, as far as requests distinguish it from others."""

    owner: str
    """Owner of its session."""
    session: str
    """World and seed of its episode."""
    connection: socket.socket | None
    """Over which it asked last; None: it has closed."""
    kept: deque[np.ndarray] = field(default_factory=deque)
    """Actions that a client which takes one at a time has not been given yet."""


class HttpRobots:
    """The robots of all addresses; safe to ask from the threads of all connections."""

    def __init__(self) -> None:
        """Make a list without robots."""
        self._robots: OrderedDict[tuple[str, str, str], list[HttpRobot]] = OrderedDict()
        """Address, client and world → robots, the one that asked last at the end."""
        self._numbers = itertools.count(1)
        self._lock = threading.Lock()

    def beginning(
        self, address: str, client: str, connection: socket.socket, world: str, seed: int | None
    ) -> tuple[HttpRobot, str | None]:
        """The robot that begins an episode.

        Returns:
            The robot, and its earlier session, which ends, where it had another one on this connection.
        """
        session = _session(world, seed)
        with self._lock:
            found = self._of_world(address, client, world)
            mine = next((robot for robot in found if robot.connection is connection), None)
            before = mine.session if mine is not None and mine.session != session else None
            free = [robot for robot in found if robot.session == session and (client or _left(robot))]
            robot = mine or (free[-1] if free else self._new(address, client, session))
            robot.session = session
            return self._used(found, robot, connection), before

    def querying(
        self, address: str, client: str, connection: socket.socket, world: str, seed: int | None, *, begins: bool
    ) -> HttpRobot:
        """The robot that queries.

        Args:
            address: The client's.
            client: Its name, or empty.
            connection: Over which it asks.
            world: Number of its world, or empty.
            seed: Of the episode; None: that which it began last.
            begins: The query begins an episode.

        Raises:
            Refused: Clients without names are in the same episode, and it is none of this connection.
        """
        if begins and seed is not None:
            return self.beginning(address, client, connection, world, seed)[0]
        session = _session(world, seed)
        with self._lock:
            found = self._of_world(address, client, world)
            known = [robot for robot in found if seed is None or robot.session == session]
            mine = [robot for robot in known if robot.connection is connection]
            free = [robot for robot in known if client or _left(robot)]
            if mine or free:
                return self._used(found, (mine or free)[-1], connection)
            if seed is None or not known:
                return self._used(found, self._new(address, client, session), connection)
            if len(known) > 1:
                raise Refused(
                    "unknown_episode",
                    f"{len(known)} clients of this address, which the server does not know apart, are in this episode; "
                    f"name the client by {CLIENT_HEADER}, or keep the connection on which it began",
                )
            return known[0]  # a client with several connections

    def left(self, connection: socket.socket) -> list[HttpRobot]:
        """A connection has closed: the robots that asked over it last."""
        with self._lock:
            gone = [robot for found in self._robots.values() for robot in found if robot.connection is connection]
            for robot in gone:
                robot.connection = None
            return gone

    def _of_world(self, address: str, client: str, world: str) -> list[HttpRobot]:
        key = address, client, world
        found = self._robots.setdefault(key, [])
        self._robots.move_to_end(key)
        while len(self._robots) > MOST_WORLDS:
            self._robots.popitem(last=False)
        return found

    def _new(self, address: str, client: str, session: str) -> HttpRobot:
        name = client or f"#{next(self._numbers)}"  # no client can have such a name
        return HttpRobot(f"http {address} {name}", session, None)

    def _used(self, found: list[HttpRobot], robot: HttpRobot, connection: socket.socket) -> HttpRobot:
        """Note over which connection a robot asks; what nobody asks for any more is forgotten."""
        robot.connection = connection
        if robot in found:
            found.remove(robot)
        found.append(robot)
        del found[:-MOST_ROBOTS]
        return robot


def _left(robot: HttpRobot) -> bool:
    """True if the connection of a robot has closed, also where its thread has not noticed yet."""
    if robot.connection is None:
        return True
    try:
        poll = select.poll()
        poll.register(robot.connection, _HUNG_UP)
        return bool(poll.poll(0))
    except (OSError, ValueError):  # it is closed here already
        return True


def _session(world: str, seed: int | None) -> str:
    return f"{world}/{seed}" if world and seed is not None else world
