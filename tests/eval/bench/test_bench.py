"""`eval bench`: bars are judged where they belong, a start that fails is named."""

import json
import subprocess
from types import SimpleNamespace

import pytest
import torch

from arena_newton.errors import ArenaError
from arena_newton.eval.bench import bench_gradients, bench_learned, bench_start
from arena_newton.policies.learned import learned_card
from tests.made_packed import packed


def test_the_policy_that_ships_is_compared_with_the_expert(tmp_path, monkeypatch, narrow):
    """Ticks of both, in turn, as a judged ratio for each task of its card; the note says where its time goes."""
    monkeypatch.setattr(learned_card, "SHIPPED", packed(tmp_path / "policy", ("boxing", "vis_navi")))
    for name, value in (("WARM_UP", 2), ("ROUNDS", 1), ("WORLDS", (1,))):
        monkeypatch.setattr(bench_learned, name, value)
    figures = list(bench_learned.learned_figures(6))
    for task, figure in zip(("boxing", "vis_navi"), figures, strict=True):
        assert figure.value > 0.0 and figure.bar == 2.0 and figure.verdict in ("pass", "MISS")
        assert f"{task}, 1 world" in figure.name
        assert "pictures" in figure.note and "policy of the package" in figure.note


def test_a_gradient_is_counted_in_bare_ticks(monkeypatch):
    """A tick backward is a judged multiple of a bare one, for each number of worlds; so is what it keeps."""
    for name, value in (("TASKS", ("football",)), ("WORLDS", (1, 2)), ("BARE", 2), ("LOOP", 8)):
        monkeypatch.setattr(bench_gradients, name, value)
    one, memory, two, loop, parts = bench_gradients.gradient_figures(1)
    for figure, worlds in ((one, "1 world"), (two, "2 worlds")):
        assert (
            figure.value > 1.0
            and figure.bar == 50.0
            and figure.name == (f"a tick backward / bare tick, football, {worlds}, CPU")
        )
    assert 1.0 < memory.value < memory.bar and "forward" in one.note
    assert 1.0 < parts.value < loop.value < loop.bar == 100.0 and parts.bar == 10.0


def test_three_starts_with_two_caches(monkeypatch):
    """The second start has the first one's cache, the third an empty one and one thread; off CUDA nothing is judged."""
    calls = []

    def fake(command, env, **options):
        calls.append((env["WARP_CACHE_PATH"], command[-1]))
        return SimpleNamespace(returncode=0, stderr="", stdout=json.dumps({"environment": 2.0}) + "\n")

    monkeypatch.setattr(subprocess, "run", fake)
    figures = list(bench_start.start_figures())
    caches = [cache for cache, _ in calls]
    assert caches[0] == caches[1] != caches[2] and ", 1, " in calls[2][1] and ", 0, " in calls[0][1]
    assert [figure.bar for figure in figures] == [70.0, 4.0]
    assert torch.cuda.is_available() or [figure.value for figure in figures] == [None, None]
    for figure in figures:  # libraries are said, but not judged
        assert "environment 2.0 s" in figure.note and "not in the figure: interpreter and libraries" in figure.note
        assert figure.value == 2.0 or figure.note.startswith("2.0 s, judged on CUDA only")


def test_a_start_that_fails_says_why(monkeypatch):
    """The last words of the process are in the error."""
    monkeypatch.setattr(
        subprocess, "run", lambda *a, **k: SimpleNamespace(returncode=1, stderr="no\nmemory left", stdout="")
    )
    with pytest.raises(ArenaError, match="the first tick was not reached: no memory left"):
        list(bench_start.start_figures())
