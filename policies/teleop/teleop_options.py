"""Flags of teleoperation, as a user gives them."""

from __future__ import annotations

from dataclasses import dataclass

from arena_newton.cli.flags import Device, Engine
from arena_newton.policies.protocols.ports import bind

__all__ = ["BrowserOptions", "RedisOptions", "SessionOptions"]


@dataclass(frozen=True)
class SessionOptions:
    """The world that a person drives in."""

    task: str = "football"
    """Task, the paper's or a package's: football double_desk pp_box open_door sit_sofa boxing vis_navi ..."""
    tracker: str = "twist2"
    """Tracker that executes the actions: twist2 sonic ..."""
    checkpoint: str | None = None
    """The tracker's weights; those that come with the package when none are named."""
    mode: str = "base"
    """Evaluation mode, as of `eval run`: base execution semantic ..."""
    variant: str | None = None
    """USD file that replaces or extends the task's scene."""
    rules: str = "paper"
    """Rule set: paper or released."""
    engine: Engine = "auto"
    device: Device[str | None] = None
    fast_physics: bool = False
    """Run a 1 ms tracker at 5 ms x 4 substeps, on a machine that is too slow for real time."""
    seed: int = 0
    """Number of the session: what its episodes draw follows from it, and no evaluation draws the same."""
    out: str | None = None
    """Folder of saved episodes; teleop/<date>_<time> when none is named."""
    ego_size: str = "320x240"
    """Size of the head camera's pictures for the person [px]."""
    no_ego: bool = False
    """No pictures of the head camera: they are what costs most on a CPU."""


@dataclass(frozen=True)
class BrowserOptions(SessionOptions):
    """Drive the robot from a page in the browser. The page is served to this machine alone, at the printed address."""

    port: int = 8765
    """TCP port of the page; 0 takes a free one."""
    view_port: int | None = None
    """TCP port of the world's view in the page; the next one after --port when not given, 0 takes a free one."""
    no_view: bool = False
    """Leave the world's view out, on a machine that is too slow for it: the head camera's picture stays."""

    def check(self) -> None:
        """Refuse ports that are taken: libraries take seconds to load, and this shows at once.

        Raises:
            InputError: One is.
        """
        bind(self.port, "--port").close()
        if not self.no_view:
            bind(self.port_of_view(), "--view-port").close()

    def port_of_view(self) -> int:
        """TCP port of the world's view; 0: a free one."""
        return self.view_port if self.view_port is not None else self.port + 1 if self.port else 0


@dataclass(frozen=True)
class RedisOptions(SessionOptions):
    """Drive the robot through a Redis server with the original benchmark's keys, as its PICO sender does."""

    host: str = "127.0.0.1"
    """Address of the Redis server."""
    port: int = 6379
    """Its TCP port."""
    db: int = 0
    """Number of its database."""
