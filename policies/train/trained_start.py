"""A trained policy with whose weights a training begins: its statistics, and its vector of tasks and trackers."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from lerobot.utils.constants import PRETRAINED_MODEL_DIR

from arena_newton.errors import InputError
from arena_newton.files.stored_json import read_object
from arena_newton.policies.learned.learned_card import SHIPPED
from arena_newton.policies.lerobot.checkpoint_facts import NORMALISES, CheckpointFacts, checkpoint_folder
from arena_newton.policies.lerobot.checkpoint_reader import PROCESSORS, WEIGHTS, PolicyCheckpoint, read_checkpoint
from arena_newton.policies.lerobot.picture_preparation import MOST_JSON
from arena_newton.policies.recipes.training_recipe import TrainingRecipe
from arena_newton.policies.train.families.policy_model import ACTION, STATE, TrainableModel
from arena_newton.policies.train.policy_options import LEARNED
from arena_newton.policies.train.training_state import put_weights, read_tensors

__all__ = ["TrainedStart", "of_training", "read_start"]

FLAG = "--start-from "
OTHER = frozenset(
    """input_features output_features device use_amp push_to_hub repo_id private tags license pretrained_path
    pretrained_revision pretrained_backbone_weights n_action_steps dropout kl_weight gradient_checkpointing
    compile_model compile_mode num_inference_steps dtype vision_encoder_name text_encoder_name""".split()
)
"""Fields of LeRobot's configuration that may differ: they say nothing of what the weights compute."""
OF_OPTIMIZER = ("optimizer_", "scheduler_")
"""Beginnings of more of them."""
VECTOR_WEIGHT = "model.encoder_env_state_input_proj.weight"
"""Weight of ACT's layer that reads the vector of task and tracker, a column for each number."""


@dataclass(frozen=True)
class TrainedStart:
    """A trained policy, without its weights."""

    checkpoint: PolicyCheckpoint
    stats: dict[str, dict[str, torch.Tensor]]
    """Statistics of state and action, by which its weights were trained."""
    digest: str
    """First 12 hex digits of the SHA-256 of the weights that a training began with here."""

    @property
    def facts(self) -> CheckpointFacts:
        """Facts that it gives."""
        return self.checkpoint.facts

    def recipe(self, settings: TrainingRecipe) -> TrainingRecipe:
        """The recipe of a training that begins here: given tasks where this policy is, without pretrained weights.

        Raises:
            InputError: Family or labels are others, or this policy is given no tasks and the training gives some.
        """
        facts = self.facts
        for flag, mine, theirs in (
            ("--policy", facts.family, settings.family),
            ("--labels", facts.labels, settings.labels),
        ):
            if mine != theirs:
                raise self._unfit(f"is of {flag} {mine}, this training of {theirs}")
        if settings.use_task_vector and not facts.task_vector:
            raise self._unfit("is given no vector of tasks, which this training has (--task-vector, or its recipe)")
        network = {**settings.network}
        if "pretrained_backbone_weights" in network:
            network["pretrained_backbone_weights"] = None
        return dataclasses.replace(settings, network=network, use_task_vector=bool(facts.task_vector))

    def check(self, model: TrainableModel, fit: str) -> None:
        """Make sure that a model is the same network, and sees pictures as this policy does.

        Args:
            fit: Of the datasets' pictures, `pad` or `native`.

        Raises:
            InputError: A field of its configuration differs; the message names it and what this policy has.
        """
        mine, theirs = self.checkpoint.config, model.policy.config
        names = [one.name for one in dataclasses.fields(theirs) if one.name not in OTHER]
        for name in (one for one in names if not one.startswith(OF_OPTIMIZER)):
            held, made = (getattr(config, name, None) for config in (mine, theirs))
            if held != made:
                text = f"{name} is {held}, in this training {made}"
                raise self._unfit(
                    f"{text}; its recipe is {self.facts.recipe or 'not known'} (--recipe, --recipe-values)"
                )
        size = f"{model.recipe.picture}x{model.recipe.height}"
        fit = "native" if model.recipe.cut_pad else fit
        for camera in self.checkpoint.cameras.values():
            if self.checkpoint.preparation or (f"{camera.width}x{camera.height}", camera.fit) != (size, fit):
                raise self._unfit(f"sees {camera.width}x{camera.height} ({camera.fit}), this training {size} ({fit})")

    def _unfit(self, text: str) -> InputError:
        return InputError(f"{FLAG}{self.checkpoint.folder}: {text}")

    def vector(
        self, tasks: Sequence[str], trackers: Sequence[str], recorded: Collection[str]
    ) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Tasks and trackers of the vector: its own, then those that it lacks.

        Args:
            tasks: Of the datasets; none: the training gives no vector.
            trackers: That their training would name.
            recorded: Trackers of the datasets.
        """
        own = self.facts
        if not own.task_vector:
            return tuple(tasks), tuple(trackers)
        named = sorted(recorded) if own.tracker_vector else []
        return _extended(own.task_vector, tasks), _extended(own.tracker_vector, named)

    def put_into(self, model: TrainableModel, tasks: Sequence[str], trackers: Sequence[str]) -> None:
        """Give a model these weights; what the vector names anew keeps new ones.

        Raises:
            InputError: They are of another network.
        """
        put_weights(
            model.policy, self.checkpoint.folder / WEIGHTS, lambda held, own: self._widen(held, own, tasks, trackers)
        )

    def _widen(
        self,
        held: dict[str, torch.Tensor],
        own: dict[str, torch.Tensor],
        tasks: Sequence[str],
        trackers: Sequence[str],
    ) -> None:
        """Fit the layer that reads the vector to a longer one."""
        before = _numbers(self.facts.task_vector, self.facts.tracker_vector)
        after = _numbers(tasks, trackers)
        if before == after:
            return
        if VECTOR_WEIGHT not in own or VECTOR_WEIGHT not in held:
            lacks = ", ".join(number[1] for number in after if number not in before)
            raise self._unfit(f"its vector has no {lacks}, and only an act that has one learns more")
        wider = own[VECTOR_WEIGHT].detach().cpu().clone()
        for column, number in enumerate(before):
            wider[:, after.index(number)] = held[VECTOR_WEIGHT][:, column].to(wider.dtype)
        held[VECTOR_WEIGHT] = wider


def read_start(named: str) -> TrainedStart:
    """Read a trained policy.

    Args:
        named: Folder of a training, of a checkpoint or of `eval pack`; `learned`: the one that ships.

    Raises:
        InputError: There is none, or a file is damaged.
    """
    folder = checkpoint_folder(SHIPPED if named == LEARNED else Path(named).expanduser(), FLAG)
    checkpoint = read_checkpoint(folder)
    stats: dict[str, dict[str, torch.Tensor]] = {}
    for name in PROCESSORS:
        steps = read_object(folder / name, MOST_JSON)["steps"]
        assert isinstance(steps, list)  # `read_checkpoint` has looked
        for step in steps:
            if step["registry_name"] in NORMALISES and step.get("state_file"):
                for key, value in read_tensors(folder / step["state_file"]).items():
                    feature, _, statistic = key.rpartition(".")
                    if feature in (STATE, ACTION):
                        stats.setdefault(feature, {})[statistic] = value
    return TrainedStart(checkpoint, stats, checkpoint.digest)


def of_training(checkpoint: Path) -> TrainedStart:
    """The start of a training that goes on: what its checkpoint has kept of it."""
    kept = read_start(str(checkpoint / PRETRAINED_MODEL_DIR))
    return dataclasses.replace(kept, digest=kept.facts.started_from)


def _extended(own: Sequence[str], others: Sequence[str]) -> tuple[str, ...]:
    return (*own, *(name for name in others if name not in own))


def _numbers(tasks: Sequence[str], trackers: Sequence[str]) -> list[tuple[str, str]]:
    """Kind and name that each number of a vector stands for, as `vector_of` has them."""
    any_other = [("tracker", "")] if trackers else []
    return [*(("task", name) for name in tasks), *(("tracker", name) for name in trackers), *any_other]
