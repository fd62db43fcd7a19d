"""Episodes at placements that a study chooses instead of the seed, in one batch of worlds, with common random numbers.

At every placement the same episode seeds are played: what the study leaves open (other objects, light, noise of the
policy) is drawn alike, so that two placements differ by the placement alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from arena_newton import rule_sets
from arena_newton import tasks as task_specs
from arena_newton.cli.quiet import quiet_warp
from arena_newton.eval.plan.config import RunConfig
from arena_newton.eval.plan.episode_plan import Episode
from arena_newton.eval.play.factories import Factories
from arena_newton.eval.play.run import check_parts, make_env
from arena_newton.eval.studies.placement_axes import Axis, moved
from arena_newton.interfaces import EpisodeResult, Planned, World
from arena_newton.rollout import Rollout
from arena_newton.tasks.base import Sample

__all__ = ["PlacedEpisode", "PlacedWorlds"]


@dataclass(frozen=True)
class PlacedEpisode:
    """One episode at one placement."""

    values: tuple[float, ...]
    """Value of each axis."""
    point: int
    """Number of the placement."""
    episode: Episode
    """Other parameters of the episode: seed, mode, budget."""

    @property
    def episode_seed(self) -> int:
        """Seed of everything that the axes leave open."""
        return self.episode.episode_seed


class PlacedWorlds:
    """The environment and the policy of a study; a context that releases both."""

    def __init__(self, config: RunConfig, axes: Sequence[Axis], factories: Factories | None = None):
        """Check policy and tracker; the environment is built at the first play.

        Raises:
            InputError: The policy or the tracker cannot do this.
        """
        quiet_warp()
        self._factories = factories or Factories()
        self.config, self.policy = check_parts(config, self._factories)
        self.axes = tuple(axes)
        task = config.flags.task[0]
        self._spec, self._rules = task_specs.get(task), rule_sets.get(config.flags.rules).task(task)
        self._env: World | None = None

    def __enter__(self) -> PlacedWorlds:
        return self

    def __exit__(self, *error: object) -> None:
        self.policy.close()
        if self._env is not None:
            self._env.close()

    def placed(
        self, points: Sequence[tuple[float, ...]], first: int = 0, episodes: Sequence[Episode] | None = None
    ) -> list[PlacedEpisode]:
        """Every episode seed of the study at every placement.

        Args:
            points: Placements, one value per axis each.
            first: Number of the first of them.
            episodes: Other episodes than the study's own.
        """
        return [
            PlacedEpisode(point, number, episode)
            for number, point in enumerate(points, start=first)
            for episode in (self.config.episodes if episodes is None else episodes)
        ]

    def play(
        self,
        episodes: Sequence[PlacedEpisode],
        on_finish: Callable[[EpisodeResult], None] | None = None,
        on_tick: Callable[[int], None] | None = None,
    ) -> list[EpisodeResult]:
        """Play episodes; results are in their order, whatever order they end in.

        Args:
            on_finish: Called with each result as it ends.
            on_tick: Called each tick with the number of active worlds.
        """
        flags = self.config.flags
        if self._env is None:
            worlds = min(flags.worlds, len(episodes))
            self._env = make_env(self.config, self._factories, self.config.episodes[0], worlds)
        return Rollout(
            self._env,
            self.policy,
            episodes,
            max_steps=self.config.episodes[0].max_steps,
            latency=flags.latency_ticks,
            samples=self._samples,
            on_finish=on_finish,
            on_tick=on_tick,
        ).run()

    def _samples(self, placed: Planned) -> dict[str, dict[str, float]]:
        assert isinstance(placed, PlacedEpisode)
        return self.sampled(placed.episode_seed, placed.values)

    def drawn(self, seed: int) -> dict[str, Sample]:
        """Samples of an episode as its seed draws them."""
        return self._spec.drawn(seed, self.config.flags.mode[0], self._rules)

    def sampled(self, seed: int, values: Sequence[float]) -> dict[str, Sample]:
        """The same with the axes at other values."""
        return moved(self.drawn(seed), self.axes, values, self._rules, self.config.flags.mode[0])
