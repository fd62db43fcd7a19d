"""The pair `camera`: both sides draw the same picture."""

import itertools

import numpy as np
import pytest
import warp as wp

from benchmarks import peer_camera
from benchmarks.bench_options import PeerOptions


@pytest.mark.skipif(wp.is_cuda_available(), reason="draws 1024 worlds there")
def test_both_draw_the_same_scene(monkeypatch):
    """Newton's picture shows what ours shows, lit or shaded, drawn by turns; without CUDA the ratio is information."""
    pairs = []
    drawn = []

    def seconds_of(draw):
        colour = draw()
        if colour is None:  # theirs, of which there are two worlds
            image = draw.func.__self__.image.numpy().view(np.uint8).reshape(2, 64, 64, 4)
            pairs.append((drawn[-1][1], image[..., :3].astype(float)))
            drawn.append(("peer", None))
        else:
            drawn.append(("ours", colour.cpu().numpy().astype(float)))
        return next(seconds)

    seconds = itertools.cycle([2 / 30, 2 / 10, 2 / 20, 2 / 20, 2 / 40, 2 / 10])
    monkeypatch.setattr(peer_camera, "seconds_of", seconds_of)
    figures = list(peer_camera.camera_figures(PeerOptions(size=64, rounds=3)))
    assert [figure.value for figure in figures] == [None, None]
    assert all("3.00 x, 30 / 10 pictures/s" in figure.note for figure in figures)
    assert [side for side, _ in drawn] == ["ours", "peer"] * 6
    for ours, theirs in pairs:
        assert ours.shape == theirs.shape == (2, 64, 64, 3)
        assert ours.mean() > 40.0 and theirs.mean() > 30.0
        # Light differs, edges are at the same pixels.
        assert np.corrcoef(ours.ravel(), theirs.ravel())[0, 1] > 0.6
