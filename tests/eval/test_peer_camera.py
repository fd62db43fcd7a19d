"""bench --peers camera: both sides draw the same picture."""

import numpy as np
import pytest
import warp as wp

from arena_newton.eval.bench import peer_camera
from arena_newton.eval.bench.bench_options import BenchOptions


@pytest.mark.skipif(wp.is_cuda_available(), reason="draws 1024 worlds there")
def test_both_draw_the_same_scene(monkeypatch):
    """Newton's picture shows what ours shows, lit or shaded; without CUDA the ratio is information."""
    pairs = []

    def rounds(ours, peer, worlds, options):
        theirs = peer.func.__self__
        peer()
        colour = theirs.image.numpy().view(np.uint8).reshape(worlds, options.peers_size, options.peers_size, 4)
        pairs.append((ours().cpu().numpy().astype(float), colour[..., :3].astype(float)))
        return [(30.0, 10.0), (20.0, 20.0), (40.0, 10.0)]

    monkeypatch.setattr(peer_camera, "_rounds", rounds)
    figures = list(peer_camera.camera_figures(BenchOptions(peers_size=64)))
    assert [figure.value for figure in figures] == [None, None]
    assert all("3.00 x, 30 / 10 pictures/s" in figure.note for figure in figures)
    for ours, theirs in pairs:
        assert ours.shape == theirs.shape == (2, 64, 64, 3)
        assert ours.mean() > 40.0 and theirs.mean() > 30.0
        # Light differs, edges are at the same pixels.
        assert np.corrcoef(ours.ravel(), theirs.ravel())[0, 1] > 0.6


def test_turns():
    """Ours and the peer's are drawn by turns, after one picture of each."""
    drawn = []
    options = BenchOptions(rounds=3)
    speeds = peer_camera._rounds(lambda: drawn.append("ours"), lambda: drawn.append("peer"), 2, options)
    assert drawn == ["ours", "peer"] * 4 and len(speeds) == 3
