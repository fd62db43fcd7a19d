"""Methods of rsl_rl that are overridden here: when a signature moves, the override must be read again."""

import importlib
import inspect
import sys
from types import ModuleType

import pytest
from rsl_rl.algorithms import PPO
from rsl_rl.env import VecEnv
from rsl_rl.models import MLPModel
from rsl_rl.modules.distribution import GaussianDistribution
from rsl_rl.runners import OnPolicyRunner
from rsl_rl.utils.logger import Logger

from arena_newton.trackers.train.__main__ import without_wandb
from arena_newton.trackers.train.logger import DeviceLogger
from arena_newton.trackers.train.model import TrackerActor, TrackerCritic, UncheckedGaussian
from arena_newton.trackers.train.ppo import TrackerPPO
from arena_newton.trackers.train.runner import TrackerRunner
from arena_newton.trackers.train.tracker_env import TrackerEnv

PAIRS = (
    (TrackerRunner, OnPolicyRunner),
    (TrackerPPO, PPO),
    (DeviceLogger, Logger),
    (TrackerEnv, VecEnv),
    (TrackerActor, MLPModel),
    (TrackerCritic, MLPModel),
    (UncheckedGaussian, GaussianDistribution),
)
UPSTREAM: dict[str, str] = {
    "OnPolicyRunner.__init__": "self env train_cfg log_dir device",
    "OnPolicyRunner._configure_multi_gpu": "self",
    "OnPolicyRunner.learn": "self num_learning_iterations init_at_random_ep_len",
    "OnPolicyRunner.save": "self path infos",
    "OnPolicyRunner.load": "self path load_cfg strict map_location",
    "PPO.__init__": "self actor critic storage num_learning_epochs num_mini_batches clip_param gamma lam "
    "value_loss_coef entropy_coef learning_rate max_grad_norm optimizer use_clipped_value_loss "
    "schedule desired_kl normalize_advantage_per_mini_batch use_mixed_precision device rnd_cfg "
    "symmetry_cfg multi_gpu_cfg grad_reduce_bucket_mb",
    "PPO.load": "self loaded_dict load_cfg strict",
    "PPO.update": "self",
    "Logger.__init__": "self log_dir cfg env_cfg num_envs is_distributed gpu_world_size gpu_global_rank device",
    "Logger._store_code_state": "self",
    "Logger.process_env_step": "self rewards dones extras intrinsic_rewards",
    "VecEnv.get_observations": "self",
    "VecEnv.step": "self actions",
    "MLPModel.__init__": "self obs obs_groups obs_set output_dim hidden_dims activation obs_normalization "
    "distribution_cfg",
    "MLPModel.forward": "self obs masks hidden_state stochastic_output",
    "MLPModel.update_normalization": "self obs",
    "GaussianDistribution.sample": "self",
}


def overridden() -> list[tuple[type, str]]:
    """Upstream's class and the method, for each that is defined again."""
    return [
        (theirs, name)
        for ours, theirs in PAIRS
        for name, member in vars(ours).items()
        if inspect.isfunction(member) and inspect.isfunction(getattr(theirs, name, None))
    ]


@pytest.mark.parametrize(("theirs", "name"), overridden())
def test_an_overridden_method_has_the_signature_that_was_overridden(theirs, name):
    """Upstream's parameters are those of the version that the override was written for."""
    parameters = " ".join(inspect.signature(getattr(theirs, name)).parameters)
    assert parameters == UPSTREAM[f"{theirs.__name__}.{name}"]


def test_only_the_start_of_a_training_goes_without_wandb(monkeypatch):
    """rsl_rl is imported without wandb, unless it is the logger or there already; afterwards it can be imported."""
    monkeypatch.delitem(sys.modules, "wandb", raising=False)
    with without_wandb("tensorboard"), pytest.raises(ModuleNotFoundError):
        importlib.import_module("wandb")
    assert "wandb" not in sys.modules
    with without_wandb("wandb"):
        assert "wandb" not in sys.modules
    monkeypatch.setitem(sys.modules, "wandb", there := ModuleType("wandb"))
    with without_wandb("tensorboard"):
        assert importlib.import_module("wandb") is there
