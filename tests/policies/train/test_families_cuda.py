"""Losses in CUDA graphs: what a captured step computes is what it computes without one."""

import dataclasses
import gc

import pytest
import torch

from arena_newton.policies.recipes.training_recipe import recipe
from arena_newton.policies.train.families import families
from arena_newton.policies.train.frames.batching import BatchMaker
from arena_newton.policies.train.policy_trainer import PolicyTrainer
from benchmarks.made_frames import made_frames
from tests.policies.train.made_stats import made_batch, made_stats

if not torch.cuda.is_available():
    pytest.skip("needs a CUDA device", allow_module_level=True)


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
@pytest.mark.parametrize("family", ["act", "diffusion", "flow"])
def test_captured_loss_is_the_loss(family, precision):
    """A replayed graph gives loss and gradients of a new batch as an uncaptured step does."""
    torch.manual_seed(0)
    chosen = recipe(family, "small", network={"dropout": 0.0, "use_vae": False} if family == "act" else {})
    model = families.build(chosen, made_stats(), "cuda")
    model.policy.eval()  # dropout draws other numbers in a graph
    assert model.capturable
    batches = [made_batch(model, seed=seed) for seed in (1, 2)]
    batch = {name: value.clone() for name, value in batches[0].items()}
    noise = model.noise(2)
    parameter = next(p for p in model.policy.parameters() if p.requires_grad)

    def step():
        # LeRobot makes constants on the host, which no graph can hold; as in training they are made on the device.
        with torch.device("cuda"), torch.autocast("cuda", torch.bfloat16, precision == "bfloat16", cache_enabled=False):
            loss = model.loss(batch, noise)
        loss.backward()
        return loss

    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        for _ in range(3):
            model.policy.zero_grad(set_to_none=True)
            step()
    torch.cuda.current_stream().wait_stream(side)
    model.policy.zero_grad(set_to_none=True)
    graph = torch.cuda.CUDAGraph()
    gc.collect()
    gc.disable()  # as the trainer does: what is freed on the device meanwhile breaks a capture off
    try:
        with torch.cuda.graph(graph, capture_error_mode="thread_local"):
            captured = step()
    finally:
        gc.enable()
    for name, value in batches[1].items():
        batch[name].copy_(value)
    graph.replay()
    torch.cuda.synchronize()
    found = captured.item(), parameter.grad.clone()
    model.policy.zero_grad(set_to_none=True)
    wanted = step()
    assert found[0] == pytest.approx(wanted.item(), rel=1e-2 if precision == "bfloat16" else 1e-4)
    assert torch.allclose(found[1], parameter.grad, rtol=0.1, atol=1e-4)


@pytest.mark.parametrize(("precision", "latent"), [("float32", True), ("bfloat16", True), ("bfloat16", False)])
def test_a_graph_takes_the_steps_of_plain_execution(precision, latent):
    """On CUDA: the losses of captured steps are those of steps that are not, with dropout, latent and augmentation."""
    losses = {}
    for graph in (False, True):
        network = {"use_vae": latent}
        settings = recipe("act", "small", precision=precision, batch_size=8, steps=20, network=network)
        settings = dataclasses.replace(settings, frozen_norms=0.75)  # after five steps
        torch.manual_seed(0)
        model = families.build(settings, made_stats(), "cuda:0")
        batches = BatchMaker(made_frames(400, 64, torch.device("cuda:0")), model.normalise, model.samples)
        trainer = PolicyTrainer(model, batches, settings, graph=graph)
        losses[graph] = []
        for _ in range(10):
            trainer.advance()
            losses[graph].append(float(trainer.loss))
        assert trainer.graphed == graph
    assert losses[True] == pytest.approx(losses[False], rel=2e-2)
