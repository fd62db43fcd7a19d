"""rsl-rl's runner with a time limit, a clean end on SIGTERM and complete checkpoints.

Its log keeps statistics on the device and fetches them once an iteration.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import statistics
import threading
import time
import warnings
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from rsl_rl.runners import OnPolicyRunner
from rsl_rl.utils.logger import Logger
from tensordict import TensorDict

from arena_newton.errors import InputError, naming
from arena_newton.trackers.train.model import TrackerActor
from arena_newton.trackers.train.ppo import IterationPPO
from arena_newton.trackers.train.tracker_env import TrackerEnv

__all__ = ["TrackerRunner"]

_SETTLED = 0.1
"""What is left of the aimed divergence and of the entropy's weight at the end of a time limit."""
_PART = ("command", "commit", "worlds", "processes", "seed", "data", "licences")
"""What the card tells of each part of a training that was resumed."""
_CARD = {*_PART, "tracker", "action_form", "drive", "physics"}
_KEPT = {
    "actor_state_dict", "critic_state_dict", "iter", "network", "norm_counts", "learning_rate", "samples", "seconds",
    "families", "sampler", "rng", "cuda_rng", "card", "last",
}  # fmt: skip
"""What every checkpoint holds."""
_STRIDE = 7919
"""Between the seeds of the further processes of trainings that are resumed at successive iterations."""
_SEEN = 1e9
"""Observations that the input statistics of a weights file stand for: a training that starts from it leaves them."""


class DeviceLogger(Logger):
    """rsl-rl's log whose episode statistics stay on the device until an iteration ends."""

    def __init__(self, **settings: Any):
        """Take rsl-rl's settings; means are over the episodes of ten iterations."""
        super().__init__(**settings)
        self.rewbuffer, self.lenbuffer = deque(maxlen=10), deque(maxlen=10)
        self._ended = torch.zeros(3, device=self.device)  # episodes, their rewards, their lengths

    def _store_code_state(self) -> list[str]:
        """Nothing: the card names the commit, and nobody asked for a copy of his changed sources."""
        return []

    def process_env_step(self, rewards, dones, extras, intrinsic_rewards=None) -> None:
        """Count one tick."""
        if self.disable_logs:
            return
        self.cur_reward_sum += rewards
        self.cur_episode_length += 1
        done = (dones > 0).float()
        self._ended += torch.stack(
            (done.sum(), (self.cur_reward_sum * done).sum(), (self.cur_episode_length * done).sum())
        )
        keep = 1.0 - done
        self.cur_reward_sum *= keep
        self.cur_episode_length *= keep

    def fetch(self) -> None:
        """Bring the statistics over; once an iteration."""
        count, reward, length = self._ended.tolist()
        self._ended.zero_()
        if count:
            self.rewbuffer.append(reward / count)
            self.lenbuffer.append(length / count)


class TrackerRunner(OnPolicyRunner):
    """Trains a tracker."""

    env: TrackerEnv
    current_learning_iteration: int
    alg: IterationPPO

    def __init__(self, env: TrackerEnv, train_cfg: dict, log_dir: str | None = None, device: str = "cpu"):
        """See rsl-rl's runner."""
        super().__init__(env, train_cfg, log_dir, device)
        self.logger: DeviceLogger = DeviceLogger(
            log_dir=log_dir,
            cfg=self.cfg,
            env_cfg=env.cfg,
            num_envs=env.num_envs,
            is_distributed=self.is_distributed,
            gpu_world_size=self.gpu_world_size,
            gpu_global_rank=self.gpu_global_rank,
            device=device,
        )
        if self.alg.mirror_loss > 0.0:
            self.alg.mirrors = (env.front_end.mirror_obs(), env.front_end.mirror_action())
        self.samples = 0
        """Samples of all processes since the training began, before resuming included."""
        self.seconds = 0.0
        """Seconds of training, before resuming included."""
        self.history: list[dict[str, float]] = []
        """What each logged iteration measured."""
        self._stop = False
        self._logged: float = 0
        self._started = False
        self._resumed: Path | None = None

    def _configure_multi_gpu(self) -> None:
        """As rsl-rl, which knows GPUs only; processes on the CPU talk through gloo."""
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
        """Begin with the network of a weights file; its critic is learnt anew before the network changes.

        Raises:
            InputError: The file is absent, of another interface or of other widths.
        """
        from arena_newton.trackers.inference import weights_file

        actor = self.alg.get_policy()
        interface = str(self.cfg["card"]["tracker"])
        weights = weights_file.load(path, interface, flag="--start-from")
        if weights.network.config() != actor.net.config():
            raise InputError(f"--start-from {path}: a network of other widths than this training's")
        form = self.cfg["card"]["action_form"]
        if weights.action_form.kind != form["kind"]:
            raise InputError(f"--start-from {path}: its action form is {weights.action_form.kind}, not {form['kind']}")
        actor.net.load_state_dict(weights.network.state_dict())
        for count in actor.counts().values():
            count.fill_(_SEEN)
        self.cfg["card"]["started_from"] = weights.card.get("commit", path.name)
        self._started = True

    def learn(self, num_learning_iterations: int, init_at_random_ep_len: bool = False, minutes: float = 0.0) -> None:
        """Train.

        Args:
            num_learning_iterations: Most iterations to run.
            init_at_random_ep_len: Unused; episodes start at random frames.
            minutes: Most minutes to run, 0 = no limit. The last iteration is finished.
        """
        main = threading.current_thread() is threading.main_thread()
        signals = (signal.SIGTERM, signal.SIGINT) if main else ()
        previous = {number: signal.signal(number, self._on_signal) for number in signals}
        try:
            self._learn(num_learning_iterations, minutes)
        finally:
            for number, handler in previous.items():
                signal.signal(number, handler)

    def _prepare(self) -> None:
        """Before the first iteration: see what observations look like and ask for the reference.

        A rollout fills the input statistics, which would otherwise jump after the first update. Where the raw action is
        no correction of the reference, the network is fitted to ask for the reference itself, for a few hundred steps:
        the start then is as good as that of a residual.
        """
        seen: list[TensorDict] = []
        wanted: list[torch.Tensor] = []
        with torch.no_grad():
            for _ in range(self.cfg["num_steps_per_env"]):
                seen.append(self.env.get_observations())
                target = self.alg.actor(seen[-1]) if self._started else self.env.reference_action()
                wanted.append(target)
                self.env.step(target + 0.3 * torch.randn_like(target))
            observations: TensorDict = torch.cat(seen)  # type: ignore[arg-type,assignment]
            self.alg.actor.update_normalization(observations)
            self.alg.critic.update_normalization(observations)
        steps = self.cfg["fit_steps"]
        if self._started or self.env.front_end.action_form.kind == "residual" or not steps:
            return
        targets = torch.cat(wanted)
        actor = self.alg.actor
        optimizer = torch.optim.Adam(actor.parameters(), lr=1e-3)
        loss = torch.zeros(())
        for k in range(steps):
            optimizer.param_groups[0]["lr"] = 1e-3 * (1.0 - k / steps)
            rows = torch.randint(len(targets), (min(len(targets), 8192),), device=targets.device)
            loss = (actor(observations[rows]) - targets[rows]).square().mean()
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()
        if not self.logger.disable_logs:
            print(f"fitted to the reference: {float(loss.detach()) ** 0.5:.3f} RMS of raw action", flush=True)

    def _on_signal(self, number: int, _: Any) -> None:
        """SIGTERM and Ctrl-C end the training after this iteration; a second Ctrl-C ends it at once."""
        if self._stop and number == signal.SIGINT:
            raise KeyboardInterrupt
        self._stop = True
        if number == signal.SIGINT and not self.logger.disable_logs:
            print("\nstopping after this iteration; Ctrl-C once more stops without writing", flush=True)

    def _learn(self, iterations: int, minutes: float) -> None:
        self.alg.train_mode()
        if self.current_learning_iteration == 0:
            self._prepare()
        if self.is_distributed:
            self.alg.broadcast_parameters()
        self.logger.init_logging_writer()
        steps = self.cfg["num_steps_per_env"]
        batch = steps * self.env.num_envs * self.gpu_world_size
        obs = self.env.get_observations()
        first = self.current_learning_iteration
        learning = list(self.alg.get_policy().parameters())
        alone = self.cfg["critic_iterations"] if self._started else 0
        # While the critic learns alone nothing diverges, and the rate only grows.
        rate = self.cfg["algorithm"]["learning_rate"] if first < alone else self.alg.learning_rate
        for parameter in learning:
            parameter.requires_grad_(first >= alone)
        began = mark = time.monotonic()
        for it in range(first, first + iterations):
            if it == alone > 0:  # the critic knows the network by now
                for parameter in learning:
                    parameter.requires_grad_(True)
                self.alg.set_learning_rate(rate)
            with torch.no_grad():
                for _ in range(steps):
                    obs, rewards, dones, extras = self.env.step(self.alg.act(obs))
                    self.alg.process_env_step(obs, rewards, dones, extras)
                    self.logger.process_env_step(rewards, dones, extras)
                # Everything so far was only queued: this reads the rollout's statistics and so ends its time.
                metrics = self.env.collect()
                self.logger.fetch()
                collected = time.monotonic()
                self.alg.compute_returns(obs)
            losses = self.alg.update()
            now = time.monotonic()
            self.current_learning_iteration = it + 1
            self.samples += batch
            self.seconds += now - mark
            self._report(it, first, iterations, collected - mark, now - collected, losses, metrics, batch)
            mark = now
            stop, elapsed = self._agree((now - began) / (60.0 * minutes) if minutes > 0.0 else 0.0)
            if stop:
                break
            self._settle(elapsed)
            if self._writes and (it + 1) % self.cfg["save_interval"] == 0:
                self.save(str(Path(self.logger.log_dir or ".") / f"model_{it + 1}.pt"))
                self._prune()
                mark = time.monotonic()
        if self._writes:
            if self.history and self.history[-1]["iteration"] != self._logged:
                self._log(self.history[-1])
            self.save(str(Path(self.logger.log_dir or ".") / "model_last.pt"))
            self.save(str(Path(self.logger.log_dir or ".") / "model_slim.pt"), slim=True)
            self.logger.stop_logging_writer()

    def _prune(self) -> None:
        """Delete older checkpoints of this training; the one that it was resumed from stays."""
        last, every = self.cfg["keep_last"], self.cfg["keep_every"]
        if not last:
            return
        folder = Path(self.logger.log_dir or ".")
        names = [re.fullmatch(r"model_(\d+)", path.stem) for path in folder.glob("model_*.pt")]
        saved = sorted(int(name[1]) for name in names if name)
        for number in [n for n in saved if n <= self.current_learning_iteration][:-last]:
            path = folder / f"model_{number}.pt"
            if path.resolve() != self._resumed and not (every and number // self.cfg["save_interval"] % every == 0):
                with contextlib.suppress(OSError):  # a training does not end over a file that stays
                    path.unlink()

    @property
    def _writes(self) -> bool:
        return self.logger.log_dir is not None and not self.logger.disable_logs

    def _agree(self, elapsed: float) -> tuple[bool, float]:
        """Whether to stop, and the share of the time limit that has passed: the same answer in every process."""
        shares = torch.tensor([float(self._stop), elapsed], dtype=torch.float64, device=self.device)
        if self.is_distributed:
            torch.distributed.all_reduce(shares, torch.distributed.ReduceOp.MAX)
            stop, elapsed = shares.tolist()
        else:
            stop = float(self._stop)
        return bool(stop > 0.0 or elapsed >= 1.0), elapsed

    def _settle(self, elapsed: float) -> None:
        """Towards the end of a time limit smaller and smaller steps, and less noise: what is learnt settles."""
        share = self.cfg["settle"]
        if not share:
            return
        left = min(max((1.0 - elapsed) / share, _SETTLED), 1.0)
        self.alg.desired_kl = self.cfg["algorithm"]["desired_kl"] * left
        self.alg.entropy_coef = self.cfg["algorithm"]["entropy_coef"] * left

    def _report(
        self,
        it: int,
        first: int,
        iterations: int,
        collect_time: float,
        learn_time: float,
        losses: dict[str, float],
        metrics: dict[str, float],
        batch: int,
    ) -> None:
        if self.logger.disable_logs:
            return
        std = self.alg.get_policy().distribution.log_std_param.detach().exp()
        row = {
            "iteration": it + 1,
            "samples": self.samples,
            "seconds": round(self.seconds, 2),
            "samples_per_s": round(batch / (collect_time + learn_time)),
            "collect_s": round(collect_time, 4),
            "learn_s": round(learn_time, 4),
            "learning_rate": self.alg.learning_rate,
            "std": float(std.mean()),
            "episode_reward": statistics.mean(self.logger.rewbuffer) if self.logger.rewbuffer else 0.0,
            "episode_length": statistics.mean(self.logger.lenbuffer) if self.logger.lenbuffer else 0.0,
            **{f"Loss/{k}": v for k, v in losses.items()},
            **metrics,
        }
        self.history.append(row)
        if it == first or (it + 1) % self.cfg["print_interval"] == 0:
            print(
                f"it {it + 1:5d}  {self.samples / 1e6:8.2f}M  {self.seconds:7.1f} s  {row['samples_per_s']:7d}/s "
                f"({collect_time:.3f}+{learn_time:.3f})  reward/s {metrics['Train/reward_per_s']:6.3f}  "
                f"mtbe {metrics['Train/seconds_between_ends']:7.2f} s  vel {metrics['Error/velocity_m_s']:.3f}  "
                f"legs {metrics['Error/legs_rad']:.3f}  lr {self.alg.learning_rate:.1e}  kl {losses['kl']:.4f}  "
                f"std {row['std']:.2f}  value {losses['value']:.3f}",
                flush=True,
            )
        if self.logger.writer is not None and (it == first or (it + 1) % self.cfg["log_interval"] == 0):
            self._log(row)

    def _log(self, row: dict[str, float]) -> None:
        """Add an iteration to progress.jsonl and to the curves."""
        self._logged = row["iteration"]
        with (Path(self.logger.log_dir) / "progress.jsonl").open("a") as file:
            file.write(json.dumps(row) + "\n")
        for name, value in row.items():
            if name != "iteration":
                self.logger.writer.add_scalar(name if "/" in name else f"Train/{name}", value, int(row["iteration"]))

    def save(self, path: str, infos: dict | None = None, *, slim: bool = False) -> None:
        """Write everything that a resumed training needs.

        Args:
            path: The file.
            infos: Anything the caller wants back from `load`.
            slim: Leave out the optimiser's moments, two thirds of the file; a resumed training builds them anew.
        """
        cuda = torch.cuda.get_rng_state(self.device) if str(self.device).startswith("cuda") else None
        actor = self.alg.get_policy()
        state = self.alg.save() | {
            "iter": self.current_learning_iteration,
            "infos": infos,
            "network": actor.net.config() if isinstance(actor, TrackerActor) else {},
            "norm_counts": actor.counts() if isinstance(actor, TrackerActor) else {},
            "learning_rate": self.alg.learning_rate,
            "samples": self.samples,
            "seconds": self.seconds,
            "started": self._started,
            "families": list(self.env.bank.family_names),
            "sampler": self.env.sampler.state_dict(),
            "rng": torch.get_rng_state(),
            "cuda_rng": cuda,
            "card": self.cfg.get("card", {}),
            "last": self.history[-1] if self.history else {},
        }
        if slim:
            del state["optimizer_state_dict"]
        temporary = Path(path).with_suffix(".part")
        torch.save(state, temporary)
        temporary.replace(path)
        self.logger.save_model(path, self.current_learning_iteration)

    def load(
        self, path: str, load_cfg: dict | None = None, strict: bool = True, map_location: str | None = None
    ) -> dict:
        """Take up a checkpoint.

        Raises:
            InputError: The file is absent or no checkpoint of this training.
        """
        with naming("--resume"):
            return self.take_up(read_checkpoint(path, map_location or str(self.device)), path, load_cfg, strict)

    def take_up(
        self, state: dict[str, Any], path: str | Path, load_cfg: dict | None = None, strict: bool = True
    ) -> dict[str, Any]:
        """Go on with the training of a checkpoint.

        Args:
            state: What `read_checkpoint` gave.
            path: Its file, for errors.
            load_cfg: rsl-rl's choice of parts; all by default.
            strict: Whether every parameter must be there.

        Raises:
            InputError: It is of another training.
        """
        card = self.cfg["card"]
        check_same(state["card"], card["tracker"], card["action_form"]["kind"], path)
        if state["families"] != self.env.bank.family_names:
            theirs, ours = ", ".join(state["families"]), ", ".join(self.env.bank.family_names)
            raise InputError(f"{path}: its references are of the families {theirs}; these are {ours}")
        if state["network"] != self.alg.get_policy().net.config():
            raise InputError(f"{path}: a network of other widths than this training's")
        self._started, self._resumed = bool(state.get("started", False)), Path(path).resolve()
        parts = {"actor": True, "critic": True, "optimizer": "optimizer_state_dict" in state, "iteration": True}
        try:
            self.alg.load(state, load_cfg or parts, strict)
        except (RuntimeError, KeyError) as error:
            raise InputError(f"{path}: a checkpoint of another version of this training") from error
        self.alg.set_learning_rate(state["learning_rate"])
        for name, count in self.alg.get_policy().counts().items():
            count.copy_(state["norm_counts"][name])
        self.current_learning_iteration = state["iter"]
        self.samples, self.seconds = state["samples"], state["seconds"]
        rank = getattr(self, "gpu_global_rank", 0)
        if not self.env.sampler.load_state_dict(state["sampler"]) and rank == 0:
            print(f"--resume {path}: other references, so where the tracker fails is found out anew")
        card |= resumed_card(state, card)
        if rank > 0:
            torch.manual_seed(self.cfg["seed"] + rank + _STRIDE * state["iter"])
        else:
            torch.set_rng_state(state["rng"].cpu())
            if state["cuda_rng"] is not None and str(self.device).startswith("cuda"):
                torch.cuda.set_rng_state(state["cuda_rng"].cpu(), self.device)
        return state["infos"] or {}


def resumed_card(state: Mapping[str, Any], card: Mapping[str, Any]) -> dict[str, Any]:
    """What the card of a training gains when it goes on with another: its parts before, and all of their licences.

    Args:
        state: The checkpoint.
        card: The card of this part.
    """
    previous = state["card"]
    part = {name: previous[name] for name in _PART} | {name: state[name] for name in ("iter", "samples", "seconds")}
    gained = {
        "earlier": [*previous.get("earlier", []), part],
        "licences": {**previous["licences"], **card["licences"]},
    }
    if "started_from" in previous:
        gained["started_from"] = previous["started_from"]
    return gained


def check_same(card: Mapping[str, Any], tracker: str, kind: str, path: str | Path) -> None:
    """Refuse to go on with the training of another tracker or action form.

    Args:
        card: The card of the checkpoint.
        tracker: Interface of this training.
        kind: Kind of this training's action form.
        path: The checkpoint's file, for errors.

    Raises:
        InputError: They differ.
    """
    if card["tracker"] != tracker:
        raise InputError(f"{path}: a training of {card['tracker']}, not of {tracker}")
    if card["action_form"]["kind"] != kind:
        raise InputError(f"{path}: its action form is {card['action_form']['kind']}, not {kind}")


def read_checkpoint(path: str | Path, device: str = "cpu") -> dict[str, Any]:
    """Read a training checkpoint: tensors and plain containers only.

    Args:
        path: The file.
        device: Where its tensors go.

    Raises:
        InputError: The file is absent or no checkpoint of this training.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of files that are something else altogether
            state = torch.load(path, weights_only=True, map_location=device)
    except FileNotFoundError:
        raise InputError(f"{path}: no such checkpoint") from None
    except Exception as error:
        raise InputError(f"{path}: not a training checkpoint ({type(error).__name__})") from error
    if not isinstance(state, dict) or not isinstance(state.get("card"), dict):
        raise InputError(f"{path}: not a checkpoint of this training")
    missing = sorted((_KEPT - set(state)) | (_CARD - set(state["card"])))
    if missing:
        raise InputError(f"{path}: not a checkpoint of this training, it lacks {', '.join(missing)}")
    return state
