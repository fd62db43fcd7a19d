"""A person who drives from a page in the browser: stick, keys or gamepad, sliders and buttons."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

from arena_newton.policies.teleop.driving import KICKS, Driver, Held
from arena_newton.policies.teleop.source import Wish

if TYPE_CHECKING:
    from arena_newton.policies.teleop.page_server import PageServer
    from arena_newton.policies.teleop.source import Control, Telemetry
    from arena_newton.policies.teleop.world_view import WorldView

__all__ = ["DEAD_MAN", "BrowserSource"]

DEAD_MAN = 0.3
"""Age of the last message at which nobody counts as driving [s]; the page sends every 0.04 s."""
STATUS_TICKS = 5
"""Ticks between two states for the page."""


class BrowserSource:
    """Actions from what is held on the page; see `source.Source`."""

    name = "browser"

    def __init__(self, server: PageServer, view: WorldView | None = None):
        """Take over a server.

        Args:
            server: The page's server; closed with the source.
            view: The world on the page, whose camera the page chooses; closed with the source.
        """
        self.server, self._view = server, view
        self.driver = Driver()
        """Makes the actions."""
        self._controls: deque[Control] = deque()
        self._shown = 0

    def begin(self, view: Telemetry) -> None:
        """See `source.Source`."""
        self.driver.begin(view)

    def wish(self, view: Telemetry) -> Wish:
        """See `source.Source`: there always is an action, without a page that of a robot that stands."""
        for event in self.server.events():
            if event in KICKS:
                self.driver.ask(event)
            else:
                self._controls.append(event)  # type: ignore[arg-type]
        held = self._held()
        if held is not None and self._view is not None:
            self._view.camera, self._view.frames = held.camera, held.frames
        control: Control = self._controls.popleft() if self._controls else "none"
        return Wish(self.driver.action(held, view), control)

    def _held(self) -> Held | None:
        """Controls held now; None where nobody drives."""
        held, age = self.server.held()
        return held if age <= DEAD_MAN else None

    def show(self, view: Telemetry) -> None:
        """See `source.Source`."""
        self._shown += 1
        if self._shown % STATUS_TICKS:
            return
        self.server.publish(
            {
                "tick": view.tick,
                "recording": view.recording,
                "outcome": view.outcome,
                "note": view.note,
                "factor": round(view.factor, 3),
                "driven": self._held() is not None,
                "position": [round(float(x), 3) for x in view.root_position],
            },
            view.image,
        )

    def close(self) -> None:
        """See `source.Source`."""
        self.server.close()
        if self._view is not None:
            self._view.close()
