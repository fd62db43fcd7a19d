"""The bench `server`: clients of a policy server beside one with the largest pictures, wrong flags are named."""

import pytest

from arena_newton.errors import InputError
from arena_newton.physics.devices import torch_threads
from benchmarks import server_load
from benchmarks.bench_options import ServerBenchOptions


@pytest.mark.parametrize("protocol", ["openpi", "vla-eval"])
def test_answers_beside_large_pictures_are_measured(protocol, monkeypatch):
    """Two clients are answered beside a third with the largest pictures, and the server's memory is measured."""
    monkeypatch.setattr(server_load, "PERIOD_S", 0.1)
    with torch_threads(1):  # of several, a fork has one
        slower, memory = server_load.load_figures(ServerBenchOptions(protocol=protocol, normal=2, large=1, seconds=0.3))
    assert slower.name.startswith(f"{protocol}: 2 clients beside 1 with 1920x1200: median answer")
    assert slower.value > 0 and memory.value > 0.1


def test_what_is_not_measured_is_named():
    """Protocols without a client here, and no clients or no time, are one line."""
    for wrong, said in (({"protocol": "arena"}, "measured are openpi vla-eval"), ({"large": 0}, "at least 1")):
        with pytest.raises(InputError, match=said):
            next(server_load.load_figures(ServerBenchOptions(**wrong)))
