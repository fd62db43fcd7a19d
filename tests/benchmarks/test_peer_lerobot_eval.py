"""The pair `lerobot_eval`: both programs are called for the same episodes, and are judged whole."""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from arena_newton.errors import ArenaError
from benchmarks import peer_lerobot_eval, peer_pairs
from benchmarks.bench_options import PeerOptions
from benchmarks.peer_lerobot_eval import lerobot_eval_figures


class _Programs:
    """Both programs, which take known seconds and write what the real ones write."""

    def __init__(self, monkeypatch, seconds, counted, played=None):
        self.commands = []
        self.seconds, self.counted, self.played = list(seconds), list(counted), played
        monkeypatch.setattr(peer_lerobot_eval, "_timed", self.timed)
        monkeypatch.setattr(peer_lerobot_eval, "load_run", lambda folder: SimpleNamespace(records=self.records))
        monkeypatch.setattr(peer_lerobot_eval, "shipped_card", lambda: object())
        monkeypatch.setattr(peer_lerobot_eval, "checkpoint_folder", lambda path, flag: path)

    def timed(self, name, command, allowed):
        self.commands.append(command)
        if name == "eval run":
            count = int(command[command.index("--worlds") + 1])
            clock = {"started_at": "2026-01-01T00:00:00.000+00:00", "finished_at": "2026-01-01T00:00:01.000+00:00"}
            self.records = [SimpleNamespace(outcome="success", **clock)] * count
        else:
            flags = dict(word.split("=", 1) for word in command if word.startswith("--") and "=" in word)
            folder = Path(flags["--env.episodes"])
            out = folder / "lerobot"
            out.mkdir(parents=True)
            count = int(flags["--eval.n_episodes"]) if self.played is None else self.played
            lines = [json.dumps({"outcome": "timeout"})] * count
            (folder / peer_lerobot_eval.OUTCOMES_FILE).write_text("\n".join(lines) + "\n" * bool(lines))
            (out / "eval_info.json").write_text(json.dumps({"overall": {"eval_s": self.counted.pop(0)}}))
        return self.seconds.pop(0)


def test_whole_commands_are_compared(tmp_path, monkeypatch):
    """Rounds take turns, with a ratio each; time and successes are named, and the CPU's ratio is information."""
    programs = _Programs(monkeypatch, [2.0, 8.0, 2.0, 12.0, 4.0, 12.0], [3.0, 4.0, 9.0])
    monkeypatch.setattr(peer_lerobot_eval.wp, "is_cuda_available", lambda: False)
    history = tmp_path / "history.jsonl"
    (figure,) = lerobot_eval_figures(PeerOptions(steps=30, history=str(history)))
    assert figure.value is None and "4.00 x, 1.000 / 0.167 episodes/s" in figure.note and "30 steps" in figure.name
    assert "without start and end 4.00 x; 1.0 s of 2.0 s, 2 solved / 3.0 s of 8.0 s, 0 solved" in figure.note
    assert json.loads(history.read_text())["ratio"] == 4.0
    ours, peer = programs.commands[:2]
    assert ours[ours.index("--max-steps") + 1] == "30" and "--env.episode_length=30" in peer
    assert "--eval.batch_size=2" in peer and "--seed=0" in peer


@pytest.mark.parametrize(("flags", "value"), [({}, 6.0), ({"episodes": 20}, None), ({"steps": 9}, None)])
def test_the_bar_is_for_the_whole_protocol(monkeypatch, flags, value):
    """With CUDA only the protocol's 60 whole episodes, three group seeds of 20, are judged."""
    programs = _Programs(monkeypatch, [10.0, 60.0], [7.0])  # ours has a second of episodes
    monkeypatch.setattr(peer_lerobot_eval.wp, "is_cuda_available", lambda: True)
    monkeypatch.setattr(peer_pairs, "device_name", lambda: "a GPU")
    monkeypatch.setattr(peer_lerobot_eval, "_physics_seconds", lambda options, checkpoint, episodes: 0.6)
    (figure,) = lerobot_eval_figures(PeerOptions(long_rounds=1, **flags))
    assert figure.value == value and figure.verdict == ("-" if value is None else "pass")
    assert "start, end and 0.6 s of physics by themselves would give about 6.25 x" in figure.note
    ours = programs.commands[0]
    seeds = ours[ours.index("--seeds") + 1 : ours.index("--repeats")]
    assert len(seeds) * 20 == flags.get("episodes", 60) and ours[ours.index("--repeats") + 1] == "20"


def test_missing_episodes_are_an_error(monkeypatch):
    """A program that played fewer episodes is not measured."""
    _Programs(monkeypatch, [1.0, 1.0], [1.0], played=1)
    monkeypatch.setattr(peer_lerobot_eval.wp, "is_cuda_available", lambda: False)
    with pytest.raises(ArenaError, match="1 episodes instead of 2"):
        list(lerobot_eval_figures(PeerOptions()))


def test_a_program_that_fails_says_its_last_line():
    """The exit code and the last line are in the error."""
    command = [peer_lerobot_eval.sys.executable, "-c", "import sys; print('first'); sys.exit('no such policy')"]
    with pytest.raises(ArenaError, match="eval run ended with code 1: no such policy"):
        peer_lerobot_eval._timed("eval run", command, (0,))
