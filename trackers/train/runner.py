"""rsl_rl's runner with a time limit, a clean end on SIGTERM and complete checkpoints."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import threading
import time
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict

from arena_newton.errors import InputError, naming
from arena_newton.trackers.inference import weights_file
from arena_newton.trackers.train.checkpoint import Card, Checkpoint
from arena_newton.trackers.train.logger import DeviceLogger, IterationTimes
from arena_newton.trackers.train.ppo import TrackerPPO
from arena_newton.trackers.train.terms.rewards import maximum
from arena_newton.trackers.train.tracker_env import TrackerEnv
from arena_newton.trackers.train.train_options import TrainOptions, runner_config

__all__ = ["CriticWarmUp", "TrackerRunner", "annealed"]

_ANNEALED = 0.1
"""Fraction of target KL and entropy coefficient that is left at the end of a time limit."""
_STRIDE = 7919
"""Difference of the seeds of the further processes of trainings that are resumed at successive iterations."""
_SEEN = 1e9
"""Observations that the input statistics of a weights file stand for: a training that starts from it keeps them."""
_PROBE = 0.3
"""Standard deviation of the raw actions around the reference in the rollout before the first iteration."""
_FIT_STEPS, _FIT_ROWS, _FIT_RATE = 300, 8192, 1e-3
"""Steps, rows per step and initial learning rate of the fit to the reference."""


class CriticWarmUp:
    """The first iterations of a training that starts from given weights: the critic learns, the network does not."""

    def __init__(self, algorithm: TrackerPPO, alone: int, first: int, rate: float):
        """Freeze the network, if the training begins within the warm-up.

        Args:
            alone: Iterations of the critic alone, 0 = none.
            first: Iteration at which the training begins or is resumed.
            rate: Learning rate after the warm-up: during it nothing diverges, and the adaptive rate only grows.
        """
        self.algorithm, self.alone = algorithm, alone
        self.rate = rate if first < alone else algorithm.learning_rate
        self._learn(first >= alone)

    def begin(self, iteration: int) -> None:
        """Let the network learn from the iteration on at which the critic knows it."""
        if iteration == self.alone > 0:
            self._learn(True)
            self.algorithm.set_learning_rate(self.rate)

    def _learn(self, learns: bool) -> None:
        for parameter in self.algorithm.get_policy().parameters():
            parameter.requires_grad_(learns)


def annealed(elapsed: float, final: float) -> float:
    """Remaining fraction of target KL and entropy coefficient, from 1 down to `_ANNEALED`.

    Args:
        elapsed: Fraction of the time limit that has passed.
        final: Fraction of the time limit, at its end, over which they fall; 0 = never.
    """
    return min(max((1.0 - elapsed) / final, _ANNEALED), 1.0) if final else 1.0


class TrackerRunner(OnPolicyRunner):
    """Trains a tracker."""

    env: TrackerEnv
    current_learning_iteration: int
    alg: TrackerPPO

    def __init__(
        self, env: TrackerEnv, options: TrainOptions, network: dict[str, Any], card: Card, log_dir: Path | None = None
    ):
        """Make a network of these widths, algorithm and log; nothing is written without `log_dir`."""
        folder = None if log_dir is None else str(log_dir)
        super().__init__(env, runner_config(options, network), folder, env.device)
        self.options, self.card = options, card
        self.logger: DeviceLogger = DeviceLogger(
            options,
            maximum(env.rewards),
            log_dir=folder,
            cfg=self.cfg,
            env_cfg=options,
            num_envs=env.num_envs,
            is_distributed=self.is_distributed,
            gpu_world_size=self.gpu_world_size,
            gpu_global_rank=self.gpu_global_rank,
            device=env.device,
        )
        self.history = self.logger.history
        self.folder = Path(folder or ".")
        """Folder of checkpoints and log."""
        if self.alg.mirror_loss > 0.0:
            self.alg.mirrors = (env.front_end.mirror_obs(), env.front_end.mirror_action())
        self.samples = 0
        """Samples of all processes since the training began, before resuming included."""
        self.seconds = 0.0
        """Seconds of training, before resuming included."""
        self.critic_iterations = 20
        """Iterations of the critic alone, in a training that starts from given weights."""
        self.interrupted = False
        """True if a signal ended the training."""
        self._started = False
        self._resumed: Path | None = None

    def _configure_multi_gpu(self) -> None:
        """Configure as rsl_rl does, which knows GPUs only; processes on the CPU talk through gloo."""
        processes = int(os.environ.get("WORLD_SIZE", "1"))
        if processes == 1 or self.device != "cpu":
            super()._configure_multi_gpu()
            return
        self.is_distributed, self.gpu_world_size = True, processes
        self.gpu_local_rank = int(os.environ.get("LOCAL_RANK", "0"))
        self.gpu_global_rank = int(os.environ.get("RANK", "0"))
        ranks = {"global_rank": self.gpu_global_rank, "local_rank": self.gpu_local_rank, "world_size": processes}
        self.cfg["multi_gpu"] = ranks
        torch.distributed.init_process_group(backend="gloo", rank=self.gpu_global_rank, world_size=processes)

    def start_from(self, path: Path) -> None:
        """Begin with the network of a weights file; a new critic learns alone before the network changes.

        Raises:
            InputError: The file is absent, of another interface or of other widths.
        """
        actor = self.alg.actor
        weights = weights_file.load(path, self.card.tracker, flag="--start-from")
        if weights.network.config() != actor.net.config():
            raise InputError(f"--start-from {path}: a network of other widths than this training's")
        kind = self.card.action_form["kind"]
        if weights.action_form.kind != kind:
            raise InputError(f"--start-from {path}: its action form is {weights.action_form.kind}, not {kind}")
        actor.net.load_state_dict(weights.network.state_dict())
        for count in actor.counts().values():
            count.fill_(_SEEN)
        self.card.started_from = weights.card.get("commit", path.name)
        self._started = True

    # -- learning ---------------------------------------------------------------------------------------------------

    def learn(self, num_learning_iterations: int, init_at_random_ep_len: bool = False, minutes: float = 0.0) -> None:
        """Train up to so many iterations or `minutes`, 0 = no limit; the last iteration is finished.

        `init_at_random_ep_len` is rsl_rl's and unused: episodes start at random frames.
        """
        main = threading.current_thread() is threading.main_thread()
        signals = (signal.SIGTERM, signal.SIGINT) if main else ()
        previous = {number: signal.signal(number, self._on_signal) for number in signals}
        try:
            self._learn(num_learning_iterations, minutes)
        finally:
            for number, handler in previous.items():
                signal.signal(number, handler)

    def _on_signal(self, number: int, _: FrameType | None) -> None:
        """SIGTERM and Ctrl-C end the training after this iteration; a second Ctrl-C ends it at once."""
        if self.interrupted and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.interrupted = True
        if number == signal.SIGINT and not self.logger.disable_logs:
            print("\nstopping after this iteration; a second Ctrl-C stops without writing", flush=True)

    def _learn(self, iterations: int, minutes: float) -> None:
        self.alg.train_mode()
        if self.current_learning_iteration == 0:
            self._prepare()
        if self.is_distributed:
            self.alg.broadcast_parameters()
        self.logger.init_logging_writer()
        obs = self.env.get_observations()
        first = self.current_learning_iteration
        warm_up = CriticWarmUp(
            self.alg, self.critic_iterations if self._started else 0, first, self.options.learning_rate
        )
        samples = self.options.steps * self.env.num_envs * self.gpu_world_size
        began = mark = time.monotonic()
        for it in range(first, first + iterations):
            warm_up.begin(it)
            obs, metrics = self._roll_out(obs)
            collected = time.monotonic()
            with torch.no_grad():
                self.alg.compute_returns(obs)
            losses = self.alg.update()
            now = time.monotonic()
            self._count(IterationTimes(collected - mark, now - collected, samples), losses, metrics, first)
            mark = now
            stop, elapsed = self._agree((now - began) / (60.0 * minutes) if minutes > 0.0 else 0.0)
            if stop:
                break
            self.anneal(elapsed)
            if self.logger.writes and (it + 1) % self.options.save_interval == 0:
                self.save(str(self.folder / f"model_{it + 1}.pt"))
                self._prune()
                mark = time.monotonic()
        if self.logger.writes:
            self.logger.finish()
            self.save(str(self.folder / "model_last.pt"))
            self.save(str(self.folder / "model_slim.pt"), slim=True)

    @torch.no_grad()
    def _roll_out(self, obs: TensorDict) -> tuple[TensorDict, dict[str, float]]:
        """Fill the storage; the last observation and the environment's means."""
        for _ in range(self.options.steps):
            obs, rewards, dones, extras = self.env.step(self.alg.act(obs))
            self.alg.process_env_step(obs, rewards, dones, extras)
            self.logger.process_env_step(rewards, dones, extras)
        # Everything so far was only queued: this reads the rollout's statistics and so ends its time.
        metrics = self.env.collect()
        self.logger.fetch()
        return obs, metrics

    def _count(self, times: IterationTimes, losses: dict[str, float], metrics: dict[str, float], first: int) -> None:
        """Count an iteration and log it."""
        self.current_learning_iteration += 1
        self.samples += times.samples
        self.seconds += times.collect + times.learn
        std = self.alg.actor.distribution.log_std_param.detach().exp()
        progress = {
            "iteration": self.current_learning_iteration,
            "samples": self.samples,
            "seconds": self.seconds,
            "learning_rate": self.alg.learning_rate,
            "std": float(std.mean()),
        }
        measured = {f"Loss/{name}": value for name, value in losses.items()} | metrics
        self.logger.record(progress, times, measured, first=self.current_learning_iteration == first + 1)

    def _prepare(self) -> None:
        """Fill the input statistics by a rollout, and fit the network to the reference where it needs that.

        Without the rollout the statistics would jump after the first update. A raw action that is not an offset from
        the reference is fitted to the reference's joints: the start then is as good as that of a residual.
        """
        seen: list[TensorDict] = []
        wanted: list[torch.Tensor] = []
        with torch.no_grad():
            for _ in range(self.options.steps):
                seen.append(self.env.get_observations())
                target = self.alg.actor(seen[-1]) if self._started else self.env.reference_action()
                wanted.append(target)
                self.env.step(target + _PROBE * torch.randn_like(target))
            observations: TensorDict = torch.cat(seen)  # type: ignore[arg-type,assignment]
            self.alg.actor.update_normalization(observations)
            self.alg.critic.update_normalization(observations)
        if self._started or self.env.front_end.action_form.kind == "residual":
            return
        error = self._fit(observations, torch.cat(wanted))
        if not self.logger.disable_logs:
            print(f"fitted to the reference: {error:.3f} RMS of raw action", flush=True)

    def _fit(self, observations: TensorDict, targets: torch.Tensor) -> float:
        """Fit the network to raw actions; the RMS error of the last step."""
        actor = self.alg.actor
        optimizer = torch.optim.Adam(actor.parameters(), lr=_FIT_RATE)
        loss = torch.zeros(())
        for k in range(_FIT_STEPS):
            optimizer.param_groups[0]["lr"] = _FIT_RATE * (1.0 - k / _FIT_STEPS)
            rows = torch.randint(len(targets), (min(len(targets), _FIT_ROWS),), device=targets.device)
            loss = (actor(observations[rows]) - targets[rows]).square().mean()
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()
        return float(loss.detach()) ** 0.5

    def _agree(self, elapsed: float) -> tuple[bool, float]:
        """Agree on whether to stop and on the passed fraction of the time limit: the same answer in every process."""
        stop = float(self.interrupted)
        if self.is_distributed:
            answers = torch.tensor([stop, elapsed], dtype=torch.float64, device=self.device)
            torch.distributed.all_reduce(answers, torch.distributed.ReduceOp.MAX)
            stop, elapsed = answers.tolist()
        return stop > 0.0 or elapsed >= 1.0, elapsed

    def anneal(self, elapsed: float) -> None:
        """Reduce target KL and entropy coefficient towards the end of a time limit; see `annealed`."""
        left = annealed(elapsed, self.options.anneal)
        self.alg.desired_kl = self.options.desired_kl * left
        self.alg.entropy_coef = self.options.entropy * left

    # -- checkpoints ------------------------------------------------------------------------------------------------

    def save(self, path: str, infos: dict[str, Any] | None = None, *, slim: bool = False) -> None:
        """Write everything that a resumed training needs; `load` returns `infos`.

        A slim file lacks the optimiser's moments, two thirds of it; a resumed training estimates them again.
        """
        on_cuda = str(self.device).startswith("cuda")
        networks, actor = self.alg.save(), self.alg.actor
        Checkpoint(
            **networks | ({"optimizer_state_dict": None} if slim else {}),
            iter=self.current_learning_iteration,
            infos=infos,
            network=actor.net.config(),
            norm_counts=actor.counts(),
            learning_rate=self.alg.learning_rate,
            samples=self.samples,
            seconds=self.seconds,
            started=self._started,
            families=self.env.bank.family_names,
            critic_widths=self.env.critic_widths,
            sampler=self.env.sampler.state_dict(),
            rng=torch.get_rng_state(),
            cuda_rng=torch.cuda.get_rng_state(self.device) if on_cuda else None,
            card=self.card,
            last=self.history[-1] if self.history else {},
        ).write(path)
        self.logger.save_model(path, self.current_learning_iteration)

    def _prune(self) -> None:
        """Delete older checkpoints of this training; the one that it was resumed from stays."""
        last, every = self.options.keep_last, self.options.keep_every
        if not last:
            return
        names = [re.fullmatch(r"model_(\d+)", path.stem) for path in self.folder.glob("model_*.pt")]
        saved = sorted(int(name[1]) for name in names if name)
        for number in [n for n in saved if n <= self.current_learning_iteration][:-last]:
            path = self.folder / f"model_{number}.pt"
            if path.resolve() != self._resumed and not (every and number // self.options.save_interval % every == 0):
                with contextlib.suppress(OSError):  # a file that cannot be deleted does not end a training
                    path.unlink()

    def load(
        self, path: str, load_cfg: dict | None = None, strict: bool = True, map_location: str | None = None
    ) -> dict[str, Any]:
        """Continue the training of a checkpoint file; all of its parts are loaded, whatever `load_cfg` says.

        Raises:
            InputError: The file is absent or not a checkpoint of this training.
        """
        with naming("--resume"):
            return self.resume(Checkpoint.read(path, map_location or str(self.device)), path)

    def resume(self, checkpoint: Checkpoint, path: str | Path) -> dict[str, Any]:
        """Continue the training of a checkpoint, whose file's path errors name.

        Raises:
            InputError: It is of another training.
        """
        self._check_fits(checkpoint, path)
        self._started, self._resumed = checkpoint.started, Path(path).resolve()
        optimizer = checkpoint.optimizer_state_dict is not None
        parts = {"actor": True, "critic": True, "optimizer": optimizer, "iteration": True}
        try:
            self.alg.load(vars(checkpoint), parts, strict=True)
        except (RuntimeError, KeyError) as error:
            raise InputError(f"{path}: a checkpoint of another version of this training") from error
        self.alg.set_learning_rate(checkpoint.learning_rate)
        for name, count in self.alg.actor.counts().items():
            count.copy_(checkpoint.norm_counts[name])
        self.current_learning_iteration = checkpoint.iter
        self.samples, self.seconds = checkpoint.samples, checkpoint.seconds
        if not self.env.sampler.load_state_dict(checkpoint.sampler) and self.gpu_global_rank == 0:
            print(f"--resume {path}: other references, so adaptive sampling starts without evidence")
        self.card.resume(checkpoint)
        if self.gpu_global_rank > 0:
            torch.manual_seed(self.options.seed + self.gpu_global_rank + _STRIDE * checkpoint.iter)
        else:
            torch.set_rng_state(checkpoint.rng.cpu())
            if checkpoint.cuda_rng is not None and str(self.device).startswith("cuda"):
                torch.cuda.set_rng_state(checkpoint.cuda_rng.cpu(), self.device)
        return checkpoint.infos or {}

    def _check_fits(self, checkpoint: Checkpoint, path: str | Path) -> None:
        checkpoint.check_same(self.card.tracker, self.card.action_form["kind"], path)
        if checkpoint.families != self.env.bank.family_names:
            theirs, ours = ", ".join(checkpoint.families), ", ".join(self.env.bank.family_names)
            raise InputError(f"{path}: its references are of the families {theirs}; these are {ours}")
        if checkpoint.network != self.alg.actor.net.config():
            raise InputError(f"{path}: a network of other widths than this training's")
        here = self.env.critic_widths
        there = checkpoint.critic_widths or here
        if list(there.items()) != list(here.items()):
            other = [name for name in {**there, **here} if there.get(name) != here.get(name)]
            raise InputError(f"{path}: other critic terms than this training's: {', '.join(other) or 'their order'}")
