"""Recorded launches do what plain ones do."""

import gc
import weakref

import warp as wp

from arena_newton.kernels import launching


@wp.kernel
def _scale(a: wp.array[float], factor: float, out: wp.array[float]):
    i = wp.tid()
    out[i] = factor * a[i]


def _run(a, factor, out):
    launching.launch_again(_scale, dim=len(a), inputs=[a, factor], outputs=[out], device=a.device)
    return out.numpy().tolist()


def test_recording_follows_values_and_arrays():
    """A recorded launch reads the array's present content, and another number or array is another launch."""
    a, b = (wp.array(v, dtype=float, device="cpu") for v in ([1.0, 2.0], [5.0, 6.0]))
    out = wp.zeros(2, dtype=float, device="cpu")
    assert _run(a, 2.0, out) == [2.0, 4.0]
    a.fill_(3.0)
    assert _run(a, 2.0, out) == [6.0, 6.0]
    assert _run(a, 10.0, out) == [30.0, 30.0]
    assert _run(b, 2.0, out) == [10.0, 12.0]


def test_tape_sees_the_launch():
    """Arrays that ask for gradients are launched where a tape records them, also after a plain recording."""
    a = wp.array([1.0, 2.0], dtype=float, device="cpu", requires_grad=True)
    out = wp.zeros(2, dtype=float, device="cpu", requires_grad=True)
    _run(a, 3.0, out)
    with wp.Tape() as tape:
        _run(a, 3.0, out)
    tape.backward(grads={out: wp.array([1.0, 1.0], dtype=float, device="cpu")})
    assert a.grad.numpy().tolist() == [3.0, 3.0]


def test_gradients_asked_for_later_are_seen():
    """An array that starts to ask for gradients after its launch was recorded gets them."""
    a, out = (wp.array([1.0, 2.0], dtype=float, device="cpu") for _ in range(2))
    _run(a, 4.0, out)
    a.requires_grad = out.requires_grad = True
    with wp.Tape() as tape:
        _run(a, 4.0, out)
    tape.backward(grads={out: wp.array([1.0, 1.0], dtype=float, device="cpu")})
    assert a.grad.numpy().tolist() == [4.0, 4.0]


def test_recordings_keep_no_dead_arrays():
    """Arrays that nobody else holds are freed, recordings and all."""
    a, out = (wp.zeros(2, dtype=float, device="cpu") for _ in range(2))
    _run(a, 2.0, out)
    alive = weakref.ref(a), weakref.ref(out)
    del a, out
    gc.collect()
    assert [reference() for reference in alive] == [None, None]


def test_store_is_bounded(monkeypatch):
    """Launches with ever new numbers do not grow the store without end."""
    monkeypatch.setattr(launching, "_LIMIT", 4)
    a, out = (wp.zeros(1, dtype=float, device="cpu") for _ in range(2))
    for i in range(20):
        _run(a, float(i), out)
    assert len(getattr(out, launching._KEPT_AT)) <= 4
