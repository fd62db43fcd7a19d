"""The server object: whom a query belongs to, what is answered together, and what a session's memory is."""

import threading
import time

import numpy as np
import pytest
from served_policies import Fails, Remembers, TurnsV4, query, state, together

from arena_newton.data.readers.label_decoder import decode_v4
from arena_newton.errors import InputError
from arena_newton.pictures.settings import CameraConfig
from arena_newton.policies.base import Chunk, Policy
from arena_newton.policies.label_reader import read_by
from arena_newton.policies.protocols.picture_fit import fitted_picture
from arena_newton.policies.protocols.policy_messages import Begin, Query
from arena_newton.policies.protocols.wire_error import WireError
from arena_newton.policies.serve.policy_server import PolicyServer, Refused
from tests.patience import PLENTY


@pytest.fixture
def made():
    """Makes started servers, closed after the test."""
    servers = []

    def make(policy, **options):
        servers.append(PolicyServer(policy, **({"max_sessions": 6, "max_wait": 0.002} | options)))
        servers[-1].start()
        policy.calls = []
        return servers[-1]

    yield make
    for server in servers:
        server.close()


def episode(server, owner, seed, values, step=4):
    """The chunks of an episode that sees `values` one after the other."""
    server.begin(owner, Begin("", seed, "boxing"))
    return [server.query(owner, query(v, seed=seed, step=step * i)).actions for i, v in enumerate(values)]


def test_queries_that_come_together_are_one_call(made):
    """Queries within max_wait are answered by one call of the policy, no more than max_batch_size at once."""
    server = made(Remembers(), max_batch_size=4, max_wait=PLENTY, tracker="sonic")
    for n in range(6):
        server.begin(str(n), Begin("", n, "boxing"))

    def ask(n):
        answer = server.query(str(n), query(n, seed=n, step=0))
        server.end(str(n), "")  # so that the others do not wait for it
        return answer

    answers = together(*[lambda n=n: ask(n) for n in range(6)])
    assert all(answer.actions.shape == (4, 40) for answer in answers)
    assert sorted(size for size, *_ in server.policy.calls) == [2, 4]
    assert server.counts.batches == {4: 1, 2: 1} and server.counts.queries == 6 and server.policy.tracker == "sonic"


def test_nobody_waits_for_sessions_that_ask_already(made):
    """A batch that holds every open session begins at once, not after max_wait."""
    server = made(Remembers(), max_wait=10 * PLENTY)
    for n in range(2):
        server.begin(str(n), Begin("", n, "boxing"))
    together(*[lambda n=n: server.query(str(n), query(n, seed=n, step=0)) for n in range(2)])
    assert server.counts.batches == {2: 1}


def test_a_session_does_not_depend_on_the_others(made):
    """An episode's chunks are the same bits alone, among others, in another row and after other episodes."""
    alone = episode(made(Remembers()), "a", 7, [0.1, 0.2, 0.3])
    crowd = made(Remembers(), max_batch_size=3, max_wait=PLENTY)
    episode(crowd, "x", 3, [0.5])  # has row 0
    crowd.begin("a", Begin("", 9, "boxing"))
    crowd.leave("x")
    episode(crowd, "a", 9, [0.9, 0.8])  # the same session before
    for n in range(4):  # each batch waits for those that have begun
        crowd.begin(f"o{n}", Begin("", n, "boxing"))

    def play(owner, *given):
        chunks = episode(crowd, owner, *given)
        crowd.leave(owner)
        return chunks

    others = [lambda n=n: play(f"o{n}", n, [0.01 * n] * 5) for n in range(4)]
    among, *_ = together(lambda: play("a", 7, [0.1, 0.2, 0.3]), *others)
    assert max(size for size, *_ in crowd.policy.calls) > 1
    assert np.array_equal(alone, among)
    assert crowd.policy.most_inside == 1, "the policy was called by two threads at once"


def test_begin_clears_the_memory_of_its_session_alone(made):
    """After `begin` an episode is as if nothing had been; another session goes on where it was."""
    server = made(Remembers())
    first = episode(server, "a", 1, [0.1, 0.2])
    other = episode(server, "b", 2, [0.3])
    assert np.array_equal(episode(server, "a", 1, [0.1, 0.2]), first)
    assert not np.array_equal(server.query("b", query(0.3, seed=2, step=4)).actions, other[0])


def test_the_same_query_again_is_not_a_new_one(made):
    """A query that is sent twice (its reply was lost) has the same answer and leaves the memory as it was."""
    server = made(Remembers())
    chunks = episode(server, "a", 1, [0.1, 0.2])
    again = server.query("a", query(0.2, seed=1, step=4)).actions
    assert np.array_equal(again, chunks[1]) and server.counts.repeated == 1
    third = server.query("a", query(0.3, seed=1, step=8)).actions
    assert np.array_equal(third, episode(made(Remembers()), "a", 1, [0.1, 0.2, 0.3])[2])


def test_another_query_at_the_same_step_is_a_new_one(made):
    """An answer is remembered for the same content only."""
    server = made(Remembers())
    chunks = episode(server, "a", 1, [0.1, 0.2])
    assert not np.array_equal(server.query("a", query(0.7, seed=1, step=4)).actions, chunks[1])
    assert server.counts.repeated == 0 and server.counts.queries == 3


def test_a_session_is_in_a_batch_once(made):
    """Queries of one session that come at the same time are answered one after the other, each from its own content."""
    server, order = made(Remembers(), max_wait=0.3), threading.Event()
    for owner in ("a", "b"):  # while b asks nothing, the batch of a is open
        server.begin(owner, Begin("", 1, "boxing"))
    put = server._put
    server._put = lambda job: (put(job), order.set())
    first, second = together(
        lambda: server.query("a", query(0.1)).actions,
        lambda: (order.wait(PLENTY), server.query("a", query(0.2)).actions)[1],
    )
    assert np.array_equal([first, second], episode(made(Remembers()), "a", 1, [0.1, 0.2]))
    assert server.counts.batches == {1: 2}


def test_step_zero_begins_an_episode(made):
    """A query of step 0 begins an episode where none was announced, with its seed, and again after others."""
    server = made(Remembers())
    first = [server.query("a", query(v, seed=5, step=s)).actions for v, s in ((0.1, 0), (0.2, 4))]
    assert np.array_equal(first, episode(made(Remembers()), "a", 5, [0.1, 0.2]))
    assert np.array_equal(server.query("a", query(0.1, seed=5, step=0)).actions, first[0])
    assert server.counts.episodes == 2


def test_an_episode_that_is_not_known_is_refused(made):
    """A query in the middle of an episode whose memory is gone is refused, not continued without it."""
    server = made(Remembers())
    with pytest.raises(Refused, match="20 actions into an episode that the server does not know") as caught:
        server.query("a", query(0.1, seed=5, step=20))
    assert caught.value.reason == "unknown_episode"
    server.begin("a", Begin("", 5, "boxing"))
    with pytest.raises(Refused, match="seed 6, the session's episode of seed 5"):
        server.query("a", query(0.1, seed=6, step=4))


def test_an_episode_of_another_client_is_not_continued(made):
    """Two clients that take each other's session get an error, whichever of them began last, and neither goes on."""
    server = made(Remembers())
    for seed_of in ("first", "second"):
        server.begin("a", Begin("", 5, "boxing"))
        if seed_of == "first":
            assert len(server.query("a", query(0.1, seed=5, step=0)).actions) == 4
    for step in (4, 8):
        with pytest.raises(Refused, match=f"{step} actions into an episode that the server does not know"):
            server.query("a", query(0.2, seed=5, step=step))
    server.query("a", query(0.3, seed=5, step=0))
    with pytest.raises(Refused, match="5 actions into an episode") as caught:
        server.query("a", query(0.2, seed=5, step=5))
    assert caught.value.reason == "unknown_episode"
    server.query("a", query(0.2, seed=5, step=3))  # it may execute fewer than it was given
    with pytest.raises(Refused, match="2 actions into an episode"):
        server.query("a", query(0.2, seed=5, step=2))


def test_a_connection_of_many_episodes_keeps_no_rows(made, monkeypatch):
    """RoboArena's protocol has no end of an episode: its idle sessions make room for the next of their connection."""
    monkeypatch.setattr("arena_newton.policies.serve.policy_server.IDLE", 0.05)
    server = made(Remembers(), max_sessions=2)
    for number in range(5):
        assert server.query("a", query(session=str(number))).actions.shape == (4, 40)
        time.sleep(0.06)
    with pytest.raises(Refused, match="all 2 sessions are in use"):
        server.query("b", query())


def test_another_sentence_is_another_query(made):
    """The answer to one instruction is not that to another, which only looks the same."""
    server = made(Remembers())
    first = server.query("a", query(0.1, seed=1, step=0, instruction="Box.")).actions
    assert np.array_equal(server.query("a", query(0.1, seed=1, step=0, instruction="Box.")).actions, first)
    assert server.counts.repeated == 1
    second = server.query("a", query(0.1, seed=1, step=3, instruction="Box."))
    third = server.query("a", query(0.1, seed=1, step=3, instruction="Stop."))
    assert server.counts.repeated == 1 and not np.array_equal(second.actions, third.actions)


def test_rows_are_freed(made):
    """A session that ends or whose owner leaves frees its row; one too many is refused."""
    server = made(Remembers(), max_sessions=2)
    for _ in range(3):
        for owner in ("a", "b"):
            server.begin(owner, Begin("", 1, "boxing"))
        with pytest.raises(Refused, match="all 2 sessions are in use") as caught:
            server.begin("c", Begin("", 1, "boxing"))
        assert caught.value.reason == "full"
        server.end("a", "")
        server.leave("b")


def test_tasks_are_asked_one_by_one(made):
    """A policy gets one task and instruction at a time; name and Gym id mean the same."""
    server = made(Remembers(), max_wait=PLENTY)
    asks = [("boxing", "Box."), ("Isaac-Move-Boxing-Bag-G129-Dex3-Wholebody", "Box."), ("football", ""), ("", "Hop.")]
    for n in range(4):
        server.begin(str(n), Begin("", n, asks[n][0], asks[n][1]))
    together(*[lambda n=n: server.query(str(n), query(n, task=asks[n][0], instruction=asks[n][1])) for n in range(4)])
    told = sorted((size, task) for size, task, _ in server.policy.calls)
    assert told == [(1, ""), (1, "football"), (2, "boxing")]
    assert [text for _, task, text in server.policy.calls if task == "football"][0].startswith("Kick")


def test_a_policy_fails_for_those_who_asked(made, capsys):
    """An error of the policy is one line without its secrets; the server goes on, and that memory is dropped."""
    server = made(Fails(), max_wait=0.0)
    for owner in "abcd":
        server.begin(owner, Begin("", 1, "boxing"))
    with pytest.raises(Refused, match=r"^the policy failed \(RuntimeError\); the server's console says more$"):
        server.query("a", query(kind=1, step=0))
    assert "a secret of the server" in capsys.readouterr().err
    with pytest.raises(Refused, match="does not know"):
        server.query("a", query(step=8))
    with pytest.raises(Refused, match=r"joint_pos\[left_shoulder_pitch_joint\] \(index 20\) is nan") as caught:
        server.query("b", query(kind=2, step=0))
    assert caught.value.reason == "policy"
    with pytest.raises(Refused, match="no plan for this world"):
        server.query("c", query(kind=3, step=0))
    with pytest.raises(Refused, match="does not know sit_sofa") as caught:
        server.begin("d", Begin("", 1, "sit_sofa"))
    assert caught.value.reason == "unfit"
    assert server.query("d", query(step=0)).actions.shape == (4, 40)


def test_another_robot_is_refused(made):
    """A query that says it executes another label protocol is refused with both names."""
    server = made(Remembers())
    with pytest.raises(Refused, match="'unitree_g1_gmt_cmd_v4', the policy's actions are for 'unitree_g1_refpose_v3_"):
        server.query("a", query(robot_type="unitree_g1_gmt_cmd_v4"))


def test_v4_is_decoded_by_session(made):
    """A policy of v4 is served as v3.1, each session with its own heading; raw labels are declared as v4."""
    server = made(read_by(TurnsV4(), "v4"))
    assert server.facts.labels == "v3.1" and server.facts.realign is None
    raw = np.zeros((15, 40), dtype=np.float32)
    raw[:, 2], raw[:, 5] = 0.8, 0.5
    expected = decode_v4(raw).reshape(3, 5, 40)
    for owner in ("a", "b"):
        server.begin(owner, Begin("", 1, "boxing"))
    for i in range(3):
        assert np.array_equal(server.query("a", query(0.1 * i, step=5 * i)).actions, expected[i])
    assert np.array_equal(server.query("b", query(step=0)).actions, expected[0])
    facts = made(TurnsV4()).facts
    assert facts.labels == "v4" and facts.action_names[5] == "action.root_yaw_rate" and facts.realign == 0.0


class _InWorld(Policy):
    def act(self, observation):
        raise InputError("--policy expert: sees the world itself")


class _Wide(Policy):
    def act(self, observation):
        return Chunk(np.zeros((6, 3, 41)))


@pytest.mark.parametrize(("policy", "message"), [(_InWorld(), "sees the world itself"), (_Wide(), r"\[6, 3, 41\]")])
def test_what_cannot_be_served_is_refused_at_the_start(policy, message):
    """A policy that needs the world, or answers no chunks, is refused before anybody asks."""
    server = PolicyServer(policy, max_sessions=6)
    with pytest.raises(InputError, match=message):
        server.start()


def test_pictures_are_fitted(made):
    """A picture of another size is scaled and padded to the policy's; one of its size stays as it is."""
    rng = np.random.default_rng(0)
    native = rng.integers(0, 255, (48, 64, 3), np.uint8)
    padded = fitted_picture(native, CameraConfig(width=32, height=32))
    assert padded.shape == (32, 32, 3) and not padded[:4].any() and not padded[28:].any()
    blocks = native.reshape(24, 2, 32, 2, 3).mean(axis=(1, 3))
    assert np.abs(padded[4:28].astype(float) - blocks).mean() < 30 and abs(padded[4:28].mean() - native.mean()) < 1
    same = rng.integers(0, 255, (32, 32, 3), np.uint8)
    assert fitted_picture(same, CameraConfig(width=32, height=32)) is same
    with pytest.raises(WireError, match="64x48 cannot be made 32x32"):
        fitted_picture(native, CameraConfig(width=32, height=32, fit="native"))
    server = made(Remembers(sees=True))
    answer = server.query("a", Query(state(), {"front": native}, "boxing", seed=1, step=0)).actions
    assert answer[0, 12] == pytest.approx(0.001 * padded.mean(), rel=1e-4)
    with pytest.raises(Refused, match="needs a picture, the message holds none"):
        server.query("a", query(step=4))


@pytest.mark.parametrize(
    ("name", "camera", "said"),
    [
        ("rear", CameraConfig(prim="/World/Rear"), "camera /World/Rear as rear"),
        ("front", CameraConfig(prim="left_wrist"), "camera left_wrist as front"),
        ("front", CameraConfig(depth=True), "the depth of front"),
    ],
)
def test_a_camera_that_no_robot_sends_is_refused(name, camera, said):
    """A policy whose cameras or depths no protocol carries is not served."""
    policy = Remembers()
    policy.cameras = {name: camera}
    with pytest.raises(InputError, match=f"remembers: observes {said}, which no protocol carries"):
        PolicyServer(policy).start()


def test_a_closed_server_refuses(made):
    """A session that waits when the server closes, and one that comes later, gets an error."""
    server = made(Remembers(pause=0.2))
    waiting = together(lambda: server.query("a", query(seed=1, step=0)), lambda: (time.sleep(0.05), server.close())[0])
    with pytest.raises(Refused, match="closing"):
        server.query("b", query(step=0))
    assert waiting[0].actions.shape == (4, 40) or isinstance(waiting[0], Refused)
