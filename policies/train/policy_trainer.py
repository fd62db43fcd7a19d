"""Steps of a training: batch, loss, gradient and update, on CUDA as one graph.

Everything random within a step comes from the device's default generator, which is seeded from seed, step and process
before it: a resumed training takes the same steps as one that was never interrupted, and a graph, whose generator is
read when it is replayed, the same as plain execution.
"""

from __future__ import annotations

import contextlib
import dataclasses
import gc
import math
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np
import torch

from arena_newton.errors import ArenaError
from arena_newton.policies.recipes.training_recipe import TrainingRecipe
from arena_newton.policies.train.families.policy_model import TrainableModel
from arena_newton.policies.train.frames.batching import (
    UNKNOWN_FRACTION,
    BalancedOrder,
    BatchMaker,
    RowOrder,
    step_seed,
)
from arena_newton.policies.train.network_compiler import compile_networks, compiler_errors, uncompiled

__all__ = ["PolicyTrainer"]

WARM_STEPS = 3
"""Steps on a side stream before a graph is captured: libraries choose their kernels, the optimizer makes its moments.
Torch's documentation of CUDA graphs asks for three; they are undone afterwards."""
SHORTEST_WARMUP = 10
"""A training with fewer steps than its recipe warms up for one of so many."""
LARGEST_RATIO = 1.5
"""Largest ratio of the gradients of a compiled network and of the network: those that are right differ by 2 %."""
COMPILED_TRIES = 2
"""Times that a compiled gradient is computed before it is called wrong."""
HELD_BATCHES = 16
"""Most batches of held-out rows whose loss is measured."""


class PolicyTrainer:
    """A network, its optimizer and the next step."""

    def __init__(
        self,
        model: TrainableModel,
        batches: BatchMaker,
        recipe: TrainingRecipe,
        *,
        weights: Sequence[float] | None = None,
        graph: bool = True,
        compiled: bool = False,
        rank: int = 0,
        ranks: int = 1,
    ):
        """Make optimizer and order of rows; nothing is trained yet.

        Args:
            model: The family's network; its policy is put into training mode.
            batches: Where batches come from.
            recipe: Settings; `steps` is the end of the schedule.
            weights: Of each pair of task and tracker in the draw of the samples; None: every picture counts alike.
            graph: On CUDA: capture a step in a graph, where the model can be captured.
            compiled: Compile the networks, at the first step.

        Raises:
            InputError: The family cannot be compiled.
            ArenaError: No episode is long enough, or none of a pair.
        """
        self.model, self.batches, self.recipe = model, batches, recipe
        self.rank, self.ranks = rank, ranks
        self.device = batches.store.device
        self.step = 0
        """Steps that are done."""
        self.graphed = graph and self.device.type == "cuda" and model.capturable
        """True if steps are graphs."""
        drop, store = model.drop_last, batches.store
        self.samples = store.samples(drop_last=drop)
        """Rows at which a sample may begin."""
        self.held = store.samples(held=True, drop_last=drop)
        """Those of held-out episodes."""
        if not len(self.samples):
            raise ArenaError(f"no episode is longer than the {drop} rows at its end at which no sample begins")
        self._order = self._ordered(weights)
        names = store.pair_names
        self._sums = torch.zeros((len(names), 2), device=self.device) if len(names) > 1 else None
        """Losses of each pair's samples since the last reading, summed, and their number."""
        self.drawn = dict.fromkeys(names if len(names) > 1 else (), 0)
        """Pair → samples of this process, since the training began or went on, up to the last reading."""
        self._rows = torch.zeros(recipe.batch_size, dtype=torch.int64, device=self.device)
        self._loss = torch.zeros((), device=self.device)
        self._norm = torch.zeros((), device=self.device)
        if self.device.type == "cuda":
            # Convolutions on tensor cores read channels last, in any other order each copies its input and output.
            model.policy.to(memory_format=torch.channels_last)
        self._compiled = compiled
        self.compiler_fault = ""
        """Reason for which steps are not compiled although they should be; empty: none."""
        self._agrees = not compiled
        """True if the compiled networks' gradient was compared with that of the networks."""
        if compiled:
            compile_networks(model)
        self.optimizer, self._lrs = _optimizer(model, recipe, self.device)
        self._parameters = [p for group in self.optimizer.param_groups for p in group["params"]]
        self._flat: torch.Tensor | None = None
        self._used: list[torch.Tensor] = []
        """Parameters on which the loss depends, whose gradients are in `_flat`."""
        self._graphs: list[torch.cuda.CUDAGraph] = []
        self._frozen = False
        """True if the vision encoder's normalisation keeps its statistics."""
        self._training_mode()
        if ranks > 1:
            for tensor in model.policy.state_dict().values():
                torch.distributed.broadcast(tensor, 0)

    def _ordered(self, weights: Sequence[float] | None) -> RowOrder | BalancedOrder:
        if weights is None:
            return RowOrder(self.samples, self.recipe.seed, self.device)
        store = self.batches.store
        pairs = store.pair.cpu().numpy()[self.samples]
        for name, count in zip(store.pair_names, np.bincount(pairs, minlength=len(weights)), strict=True):
            if not count:
                raise ArenaError(f"--balance task: no episode of {name} is trained on that is long enough")
        return BalancedOrder(self.samples, pairs, weights, self.recipe.seed, self.device)

    @property
    def loss(self) -> torch.Tensor:
        """Loss of the last step, of this process; reading it waits for the device."""
        return self._loss

    @property
    def gradient_norm(self) -> torch.Tensor:
        """Norm of the last step's gradient before it was clipped."""
        return self._norm

    def fix_steps(self, steps: int) -> None:
        """Let the schedule end after so many steps, of which the warm-up takes a tenth at most."""
        warmup = min(self.recipe.warmup_steps, steps // SHORTEST_WARMUP)
        self.recipe = dataclasses.replace(self.recipe, steps=max(1, steps), warmup_steps=warmup)

    def learning_rate(self) -> float:
        """Learning rate of the next step, of all but the vision encoder."""
        return self.recipe.lr * self.recipe.lr_factor(self.step)

    def advance(self) -> None:
        """Take one step; on CUDA it is launched, not awaited."""
        if self._norms_frozen != self._frozen:
            self._frozen = self._norms_frozen
            self._graphs.clear()
            self._training_mode()
            self._agrees = not self._compiled or bool(self.compiler_fault)
        with compiler_errors() if self._compiled else contextlib.nullcontext():
            if not self._agrees:
                self._compare_compiled()
            with uncompiled() if self.compiler_fault else contextlib.nullcontext():
                self._advance()

    def _advance(self) -> None:
        if self.graphed and not self._graphs:
            self._capture()
        self._prepare(self.step)
        if self._graphs:
            self._graphs[0].replay()
            if self.ranks > 1:
                self._average()
                self._graphs[1].replay()
        else:
            self._descend()
            if self.ranks > 1:
                self._average()
            self._update()
        self.step += 1

    @property
    def _norms_frozen(self) -> bool:
        """True in the last steps, of which the recipe gives the fraction."""
        return self.step >= self.recipe.steps * (1.0 - self.recipe.frozen_norms)

    def _training_mode(self) -> None:
        self.model.policy.train()
        for module in self.model.policy.modules() if self._frozen else ():
            if isinstance(module, torch.nn.BatchNorm2d):
                module.eval()

    @contextlib.contextmanager
    def _evaluating(self) -> Iterator[None]:
        """The policy in evaluation mode."""
        self.model.policy.eval()
        try:
            yield
        finally:
            self._training_mode()

    def _prepare(self, step: int) -> None:
        """Rows, learning rates and seed of a step."""
        rows = self._order.rows(step, self.recipe.batch_size, rank=self.rank, ranks=self.ranks)
        self._rows.copy_(rows, non_blocking=True)
        factor = self.recipe.lr_factor(step)
        for group, lr in zip(self.optimizer.param_groups, self._lrs, strict=True):
            if isinstance(group["lr"], torch.Tensor):
                group["lr"].fill_(lr * factor)
            else:
                group["lr"] = lr * factor
        torch.manual_seed(step_seed(self.recipe.seed, step, self.rank))

    def _precision(self) -> contextlib.AbstractContextManager[object]:
        if self.recipe.precision == "bfloat16":
            # Weights that were cast outside of a graph would be stale within it.
            return torch.autocast(self.device.type, torch.bfloat16, cache_enabled=False)
        return contextlib.nullcontext()

    def _descend(self) -> None:
        """Batch, loss and gradient."""
        recipe = self.recipe
        batch = self.batches(
            self._rows,
            looks=True,
            shift=recipe.shift_px,
            colour=recipe.colour,
            transforms=recipe.image_transforms,
            unknown=UNKNOWN_FRACTION,
        )
        # LeRobot makes some constants on the host and copies them, which no graph can hold; here they are made on the
        # device.
        with self.device if self.graphed else contextlib.nullcontext(), self._precision():
            loss, each = self.model.losses(batch, self.model.noise(len(self._rows)))
        self._add(self._sums, self._rows, each)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self._loss.copy_(loss.detach())
        if self.ranks > 1:
            self._used = [p for p in self._parameters if p.grad is not None]
            gradients = [p.grad.float().reshape(-1) for p in self._used if p.grad is not None]
            if self._flat is None:
                self._flat = torch.cat(gradients)
            else:
                torch.cat(gradients, out=self._flat)

    def _add(self, sums: torch.Tensor | None, rows: torch.Tensor, losses: torch.Tensor) -> None:
        """Add the losses of samples to those of their pairs."""
        if sums is not None:
            pairs = self.batches.store.pair[rows]
            sums.index_add_(0, pairs, torch.stack([losses.float(), torch.ones_like(losses.float())], dim=1))

    def pair_losses(self) -> dict[str, float]:
        """Mean loss of each pair's samples of this process since the last call; waits for the device.

        Of a training with several pairs of task and tracker; a pair of which none was drawn is left out.
        """
        if self._sums is None:
            return {}
        found = dict(zip(self.drawn, self._sums.tolist(), strict=True))
        self._sums.zero_()
        for name, (_, count) in found.items():
            self.drawn[name] += int(count)
        return {name: total / count for name, (total, count) in found.items() if count}

    def _whole(self) -> None:
        """A step of a single process."""
        self._descend()
        self._update()

    def _average(self) -> None:
        """Mean of the gradients of all processes."""
        assert self._flat is not None
        torch.distributed.all_reduce(self._flat)
        self._flat /= self.ranks

    def _update(self) -> None:
        """Clip the gradient and change the weights."""
        if self._flat is not None:
            parts = self._flat.split([p.numel() for p in self._used])
            for parameter, part in zip(self._used, parts, strict=True):
                parameter.grad = torch.empty_like(parameter).copy_(part.view_as(parameter))
        norm = torch.nn.utils.clip_grad_norm_(self._parameters, self.recipe.grad_clip)
        self._norm.copy_(norm.detach())
        self.optimizer.step()

    def _compare_compiled(self) -> None:
        """Compare the gradient of the compiled networks with that of the networks, and leave all tensors as they are.

        A compiler's mistakes raise no error. Both draw other random numbers, so the norms are close, not equal. The
        first call of new kernels also measures which of them are fast, so a wrong one is computed again.

        If they differ, all further steps are the network's own.
        """
        before = _copied(self.model.policy.state_dict())
        own = self._gradient_norms(uncompiled())
        norm = math.hypot(*own.values())
        for _ in range(COMPILED_TRIES):
            each = self._gradient_norms(contextlib.nullcontext())
            compiled = math.hypot(*each.values())
            self._agrees = norm / LARGEST_RATIO <= compiled <= norm * LARGEST_RATIO
            if self._agrees:
                break
        self._put_back(before)
        if self._agrees:
            return
        self._agrees = True  # from here on there is nothing to compare
        worst = max(each, key=lambda name: abs(each[name] - own.get(name, 0.0)))
        self.compiler_fault = (
            f"--compile: step {self.step}: the compiled network's gradient has norm {compiled:.4g}, the network's "
            f"own {norm:.4g} (most in {worst}): torch {torch.__version__} compiles it wrongly; trains on without"
        )

    def _gradient_norms(self, context: contextlib.AbstractContextManager[None]) -> dict[str, float]:
        """Norm of each parameter's gradient in a step that is not taken."""
        self._prepare(self.step)
        with context:
            self._descend()
        found = {name: p.grad for name, p in self.model.policy.named_parameters() if p.grad is not None}
        norms = torch.stack([torch.linalg.vector_norm(gradient.float()) for gradient in found.values()])
        return dict(zip(found, norms.tolist(), strict=True))

    def _put_back(self, before: Mapping[str, torch.Tensor]) -> None:
        """Give the network its tensors of before steps that do not count, and forget their losses and gradients."""
        with torch.no_grad():
            for name, tensor in self.model.policy.state_dict().items():
                tensor.copy_(before[name])
        if self._sums is not None:
            self._sums.zero_()
        self.optimizer.zero_grad(set_to_none=True)

    def _capture(self) -> None:
        """Capture a step: one graph, or two with the exchange of gradients between them.

        Raises:
            ArenaError: The family's loss cannot be captured.
        """
        before = _copied(self.model.policy.state_dict())
        moments = _copied_moments(self.optimizer)
        side = torch.cuda.Stream(self.device)
        side.wait_stream(torch.cuda.current_stream(self.device))
        with torch.cuda.stream(side):
            for _ in range(WARM_STEPS):
                self._prepare(self.step)
                self._descend()
                if self.ranks > 1:
                    self._average()
                self._update()
        torch.cuda.current_stream(self.device).wait_stream(side)
        # Undone in the same tensors, whose addresses the graph keeps.
        self._put_back(before)
        _restore_moments(self.optimizer, moments)
        parts: list[Callable[[], None]] = [self._descend, self._update] if self.ranks > 1 else [self._whole]
        pool = torch.cuda.graph_pool_handle()
        for part in parts:
            graph = torch.cuda.CUDAGraph()
            try:
                # Other threads (a process group's watchdog) may use the device meanwhile.
                with _nothing_collected(), torch.cuda.graph(graph, pool=pool, capture_error_mode="thread_local"):
                    part()
            except RuntimeError as error:
                reason = " ".join(str(error).split())[:200]
                raise ArenaError(f"no CUDA graph could be captured; --no-graph trains without it ({reason})") from error
            self._graphs.append(graph)

    @torch.no_grad()
    def check_agreement(self) -> None:
        """Make sure that all processes hold the same weights; they call this at the same step.

        Raises:
            ArenaError: They do not.
        """
        if self.ranks == 1:
            return
        weights = torch.cat([p.detach().reshape(-1).double() for p in self._parameters])
        mine = torch.stack([weights.sum(), weights.square().sum()])
        least, most = mine.clone(), mine.clone()
        torch.distributed.all_reduce(least, torch.distributed.ReduceOp.MIN)
        torch.distributed.all_reduce(most, torch.distributed.ReduceOp.MAX)
        if not torch.equal(least, most):
            raise ArenaError(f"the {self.ranks} processes hold different weights at step {self.step}")

    @torch.no_grad()
    def held_out_losses(self) -> tuple[float, dict[str, float]]:
        """Mean loss of held-out rows spread over their episodes, without augmentation; NaN where none are held out.

        The same rows and noise each time, so that values of different steps differ by the network alone.

        Returns:
            That of all rows, and that of each pair, as of `pair_losses`.
        """
        if not len(self.held):
            return float("nan"), {}
        size = min(self.recipe.batch_size, len(self.held))
        count = min(HELD_BATCHES, len(self.held) // size)
        chosen = self.held[np.linspace(0, len(self.held) - 1, count * size).round().astype(np.int64)]
        rows = torch.from_numpy(chosen).to(self.device)
        total = torch.zeros((), device=self.device)
        sums = None if self._sums is None else torch.zeros_like(self._sums)
        with self._evaluating(), uncompiled() if self._compiled else contextlib.nullcontext():
            torch.manual_seed(step_seed(self.recipe.seed, -1))
            for part in rows.split(size):
                with self._precision():
                    loss, each = self.model.losses(self.batches(part), self.model.noise(size))
                total += loss.float()
                self._add(sums, part, each)
        found = zip(self.drawn, [] if sums is None else sums.tolist(), strict=True)
        return float(total / count), {name: all_of / number for name, (all_of, number) in found if number}


def _optimizer(
    model: TrainableModel, recipe: TrainingRecipe, device: torch.device
) -> tuple[torch.optim.Optimizer, list[float]]:
    """The optimizer, and the highest learning rate of each of its groups."""
    made = model.groups()
    lrs = [float(group["lr"]) for group in made]  # type: ignore[arg-type]  # a number
    on_cuda = device.type == "cuda"
    for group, lr in zip(made, lrs, strict=True):
        # In a graph a number would be the one of its capture.
        group["lr"] = torch.tensor(lr, device=device) if on_cuda else lr
    kind = {"adam": torch.optim.Adam, "adamw": torch.optim.AdamW}[recipe.optimizer]
    settings: Mapping[str, object] = {"fused": True, "capturable": True} if on_cuda else {}
    optimizer = kind(made, betas=recipe.betas, eps=recipe.eps, weight_decay=recipe.weight_decay, **settings)
    return optimizer, lrs


def _copied(tensors: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return {name: tensor.detach().clone() for name, tensor in tensors.items()}


def _copied_moments(optimizer: torch.optim.Optimizer) -> dict[torch.Tensor, dict[str, torch.Tensor]]:
    return {parameter: _copied(state) for parameter, state in optimizer.state.items()}


def _restore_moments(
    optimizer: torch.optim.Optimizer, moments: Mapping[torch.Tensor, Mapping[str, torch.Tensor]]
) -> None:
    """Put moments back into the tensors that exist now; those that were none are 0."""
    with torch.no_grad():
        for parameter, state in optimizer.state.items():
            for name, tensor in state.items():
                if parameter in moments:
                    tensor.copy_(moments[parameter][name])
                else:
                    tensor.zero_()


@contextlib.contextmanager
def _nothing_collected() -> Iterator[None]:
    """No collection of garbage: what it frees of an earlier training on the device would break a capture off."""
    gc.collect()
    was = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was:
            gc.enable()
