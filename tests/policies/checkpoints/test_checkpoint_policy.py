"""Checkpoints of LeRobot as policies: what they answer, and on what it depends."""

import numpy as np
import pytest
import torch
from made_checkpoints import CHUNK, FRONT, STATE, facts, follow, save, seen

from arena_newton import policies
from arena_newton.errors import InputError
from arena_newton.policies.lerobot.checkpoint_policy import LeRobotPolicy
from arena_newton.testing import check_policy

FAMILIES = ("act", "diffusion", "flow", "two")
SEEDS = (11, 12, 13)


@pytest.fixture(scope="module")
def made(checkpoints):
    """Family → its policy."""
    return {family: LeRobotPolicy(folder) for family, folder in checkpoints.items()}


@pytest.mark.parametrize("family", FAMILIES)
def test_results_do_not_depend_on_the_number_of_worlds(made, family):
    """One world alone, 3 that begin at different ticks and 8 at once give an episode the same actions, bit for bit."""
    policy = made[family]
    few = follow(policy, SEEDS, 2, asks=(0, 4, 9))
    many = follow(policy, [*range(100, 105), *SEEDS], 2)
    for seed in SEEDS:
        alone = follow(policy, [seed], 2)[seed]
        assert torch.equal(alone, few[seed])
        assert torch.equal(alone, many[seed])
    assert not torch.equal(few[11], few[12])


@pytest.mark.parametrize("family", ["diffusion", "flow", "two"])
def test_the_global_generator_has_no_say(made, family):
    """Drawing numbers between queries changes nothing, and a policy leaves the global generator as it found it."""
    policy = made[family]
    before = follow(policy, SEEDS[:2], 2)
    state = torch.get_rng_state()
    torch.manual_seed(991)
    torch.randn(1000)
    polluted = torch.get_rng_state()
    assert all(torch.equal(before[seed], rows) for seed, rows in follow(policy, SEEDS[:2], 2).items())
    assert torch.equal(torch.get_rng_state(), polluted)
    torch.set_rng_state(state)


@pytest.mark.parametrize("family", ["diffusion", "flow"])
def test_noise_is_an_episodes_own(made, family):
    """The same picture gives another answer to another seed and at another query, and the same again after a reset."""
    policy = made[family]

    def answers(seed):
        policy.reset([seed], ["boxing"])
        return [policy.act(seen([5], [0])).actions.clone() for _ in range(2)]

    first, second = answers(1)
    assert not torch.equal(first, second)
    assert not torch.equal(first, answers(2)[0])
    assert all(torch.equal(a, b) for a, b in zip((first, second), answers(1), strict=True))


@pytest.mark.parametrize("cameras", [("front",), ("right_wrist", "front", "left_wrist")])
def test_an_answer_is_what_lerobot_computes(made, checkpoints, tmp_path, cameras):
    """ACT of one camera and of three: the numbers of LeRobot's own loading, processors and network, the first ones."""
    from lerobot.policies.act.modeling_act import ACTPolicy
    from lerobot.policies.factory import make_pre_post_processors

    folder, policy = checkpoints["act"], made["act"]
    if len(cameras) > 1:
        folder = save(tmp_path, "act", facts=facts(family="act"), cameras=cameras)
        policy = LeRobotPolicy(folder)
    network = ACTPolicy.from_pretrained(folder)
    before, after = make_pre_post_processors(network.config, pretrained_path=folder)
    shown = seen([11], [0], cameras=cameras)
    batch = {STATE: shown.state}
    for name, image in shown.images.items():
        batch[f"observation.images.{name}"] = image.permute(0, 3, 1, 2).contiguous().float() / 255.0
    chunk = network.predict_action_chunk(before(batch))
    wanted = torch.stack([after(chunk[:, tick]) for tick in range(CHUNK)], dim=1)
    policy.reset([11], ["boxing"])
    assert torch.equal(policy.act(shown).actions, wanted)


@pytest.mark.parametrize("family", ["diffusion", "flow"])
def test_sampling_is_lerobots_but_for_the_noise(made, family, monkeypatch):
    """LeRobot's own sampling gives the same actions once the global generator is set as an episode's."""
    from arena_newton.policies.lerobot import checkpoint_network
    from arena_newton.policies.lerobot.network_noise import Draw, generators

    policy, shown = made[family], seen([11], [0])
    policy.reset([11], ["boxing"])
    ours = policy.act(shown).actions
    network = policy._network
    batch = network.before(
        {
            STATE: shown.state[:, None],
            FRONT: shown.image.permute(0, 3, 1, 2).float()[:, None] / 255.0,
            "task": [shown.instruction],
        }
    )
    fresh = checkpoint_network.get_policy_class(policy.checkpoint.type).from_pretrained(policy.checkpoint.folder)
    state = torch.get_rng_state()
    torch.set_rng_state(generators([Draw(11, 0)])[0].get_state())
    pictures = {"observation.images": batch[FRONT].unsqueeze(2)}
    with torch.no_grad():
        if family == "diffusion":
            theirs = fresh.diffusion.generate_actions(batch | pictures)
        else:
            theirs = fresh._generate_actions(batch | pictures)
    torch.set_rng_state(state)
    assert torch.allclose(network.after(theirs[0])[None], ours, atol=1e-6)


def test_two_ticks_are_looked_at(made, monkeypatch):
    """A policy of two observations is shown the tick before its query, and at first the same tick twice."""
    policy, given = made["two"], []
    policy.check()
    predict = policy._network.predict

    def watch(batch, instruction, draws):
        given.append(batch[STATE].clone())
        return predict(batch, instruction, draws)

    monkeypatch.setattr(policy._network, "predict", watch)
    follow(policy, [11], 3)
    ticks = {tick: seen([11], [tick]).state[0] for tick in range(3 * CHUNK)}
    assert [tuple(rows.shape) for rows in given] == [(1, 2, 64)] * 3
    wanted = [(0, 0), (CHUNK - 1, CHUNK), (2 * CHUNK - 1, 2 * CHUNK)]
    for rows, pair in zip(given, wanted, strict=True):
        assert all(torch.equal(rows[0, i], ticks[tick]) for i, tick in enumerate(pair))


def test_replan_executes_the_first_actions(made, checkpoints):
    """--replan 2 takes two actions of every answer, each of which is the one that the whole chunk begins with."""
    policy = policies.get(f"lerobot:{checkpoints['act']}", replan=2)
    assert policy.chunk_size == 2
    rows = follow(policy, [11], 3)[11]
    for query in range(3):
        made["act"].reset([11], ["boxing"])
        whole = made["act"].act(seen([11], [2 * query])).actions[0]
        assert torch.equal(rows[2 * query : 2 * query + 2], whole[:2])
    with pytest.raises(InputError, match=r"--replan 11: expected 1 to 10"):
        LeRobotPolicy(checkpoints["act"], replan=11)


def test_ensembling_is_the_mean_of_all_chunks_that_cover_a_tick(checkpoints):
    """With equal weights; a reset of one world forgets its own chunks alone."""
    policy = LeRobotPolicy(checkpoints["act"], replan=3, ensemble=True)
    whole = LeRobotPolicy(checkpoints["act"], replan=10)
    chunks = {}
    for tick in range(0, 15, 3):
        whole.reset([11], ["boxing"])
        chunks[tick] = whole.act(seen([11], [tick])).actions[0]
    rows = follow(policy, [11, 12], 5)
    for tick in range(15):
        covering = [chunk[tick - begin] for begin, chunk in chunks.items() if 0 <= tick - begin < 10]
        assert torch.allclose(rows[11][tick], torch.stack(covering).mean(0), atol=1e-6)
    again = follow(policy, [11, 12], 5)
    assert all(torch.equal(rows[seed], again[seed]) for seed in rows)
    policy.reset([12, 12], ["boxing"] * 2, np.array([False, True]))
    answer = policy.act(seen([11, 12], [15, 0]))
    assert torch.equal(answer.actions[1], rows[12][:3])
    assert LeRobotPolicy(checkpoints["act"], ensemble=True).chunk_size == 1


def test_a_world_that_cannot_be_served_is_named(made):
    """A state that is not finite is that world's error; the others get what they get without it."""
    policy = made["act"]
    policy.reset([11, 12], ["boxing"] * 2)
    shown = seen([11, 12], [0, 0])
    sound = policy.act(shown).actions.clone()
    policy.reset([11, 12], ["boxing"] * 2)
    shown.state[1, 3] = float("nan")
    answer = policy.act(shown)
    assert answer.errors == {1: "its state is not finite"}
    assert torch.equal(answer.actions[0], sound[0])


def test_the_task_vector_names_the_task(tmp_path):
    """Two tasks give two answers to the same picture; a task that the checkpoint does not know is refused by name."""
    known = ("boxing", "vis_navi")
    policy = LeRobotPolicy(save(tmp_path / "both", "act", facts=facts(task_vector=known)))
    answers = []
    for task in known:
        policy.check_task(task)
        policy.reset([11], [task])
        answers.append(policy.act(seen([11], [0], task=task)).actions)
    assert not torch.equal(*answers)
    with pytest.raises(InputError, match="was trained on boxing, vis_navi, not on football"):
        policy.check_task("football")


def test_the_task_vector_names_the_tracker(tmp_path):
    """Each tracker has its own answer to the same picture; those that the vector does not name have one of theirs."""
    vectors = {"task_vector": ("boxing",), "tracker_vector": ("sonic", "twist2")}
    policy = LeRobotPolicy(save(tmp_path / "both", "act", facts=facts(**vectors)))
    answers = {}
    for tracker in ("sonic", "twist2", "falcon", ""):
        policy.reset([11], ["boxing"])
        answers[tracker] = policy.act(seen([11], [0], tracker=tracker)).actions
    assert torch.equal(answers["falcon"], answers[""])
    assert len({tuple(one.flatten().tolist()) for one in answers.values()}) == 3
    assert policy.describe()["tracker_vector"] == ["sonic", "twist2"]


def test_half_precision_computes_in_float32(tmp_path, checkpoints):
    """Weights that are stored in float16 give nearly the same actions, in float32."""
    from safetensors.torch import load_file, save_file

    folder = tmp_path / "half"
    folder.mkdir()
    for file in checkpoints["act"].iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    weights = {
        name: value.half() if value.ndim > 1 else value
        for name, value in load_file(folder / "model.safetensors").items()
    }
    save_file(weights, folder / "model.safetensors")
    rows = [follow(LeRobotPolicy(where), [11], 1)[11] for where in (folder, checkpoints["act"])]
    assert rows[0].dtype == torch.float32
    assert 0.0 < (rows[0] - rows[1]).abs().max() < 1e-3


@pytest.mark.parametrize(("family", "options"), [("two", {}), ("act", {"replan": 3, "ensemble": True})])
def test_it_keeps_every_promise_of_a_policy(checkpoints, family, options):
    """Those that `policies check` tries, with whole chunks and with averaged ones."""
    check_policy(LeRobotPolicy(checkpoints[family], **options), task="boxing")


def test_what_a_result_records(made, checkpoints):
    """Family, hash of the weights and how chunks are executed; equal for the same checkpoint at another path."""
    about = made["flow"].describe()
    assert about["family"] == "flow"
    assert about["noise"] == "sha256(policy seed|look)"
    assert made["act"].describe()["noise"] is None
    assert len(about["weights"]) == 12
    assert (about["predicted"], about["replan"], made["act"].describe()["predicted"]) == (CHUNK, CHUNK, 10)
    assert str(checkpoints["flow"]) not in str(about)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("family", FAMILIES)
def test_rows_are_independent_on_a_gpu(checkpoints, family):
    """On CUDA each forward pass has one size, so that 1, 3 and 20 worlds give the same actions, bit for bit."""
    policy = LeRobotPolicy(checkpoints[family], device="cuda")
    many = follow(policy, [*range(100, 117), *SEEDS], 3)
    assert all(torch.equal(follow(policy, [seed], 3)[seed], many[seed]) for seed in SEEDS)
