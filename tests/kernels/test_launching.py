"""Recorded launches do what plain ones do."""

import gc
import threading
import weakref

import pytest
import warp as wp

from arena_newton.kernels import launching


@wp.kernel
def _scale(a: wp.array[float], factor: float, out: wp.array[float]):
    i = wp.tid()
    out[i] = factor * a[i]


def _launch(a, factor, out):
    launching.launch(_scale, dim=len(a), inputs=[a, factor], outputs=[out], device=a.device)


def test_recording_reads_present_content(device):
    """A recorded launch does nothing until it is called, and then reads the arrays as they are."""
    a, out = wp.array([1.0, 2.0], dtype=float, device=device), wp.zeros(2, dtype=float, device=device)
    recorded = launching.record(_launch, a, 2.0, out)
    assert out.numpy().tolist() == [0.0, 0.0]
    recorded()
    assert out.numpy().tolist() == [2.0, 4.0]
    a.fill_(3.0)
    recorded()
    assert out.numpy().tolist() == [6.0, 6.0]


def test_launches_keep_their_order(device):
    """A recording of several launches repeats all of them, the later on the results of the earlier."""
    a, b, c = (wp.full(2, v, dtype=float, device=device) for v in (1.0, 0.0, 0.0))

    def both():
        _launch(a, 3.0, b)
        _launch(b, 5.0, c)

    launching.record(both)()
    assert c.numpy().tolist() == [15.0, 15.0]


@wp.struct
class _Pair:
    factor: float
    offset: float


@wp.kernel
def _affine(a: wp.array2d[float], pair: _Pair, shift: wp.vec3, flag: bool, out: wp.array2d[float]):
    i, j = wp.tid()
    if flag:
        out[i, j] = pair.factor * a[i, j] + pair.offset + shift[j]


def test_arguments_of_every_kind_are_packed_once():
    """On the CPU a recorded launch calls the machine code itself, with arrays, structs, vectors, numbers and flags."""
    a, pair = wp.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]], dtype=float, device="cpu"), _Pair()
    pair.factor, pair.offset = 2.0, 1.0
    plain, again = (wp.zeros((2, 3), dtype=float, device="cpu") for _ in range(2))

    def affine(out):
        launching.launch(_affine, dim=a.shape, inputs=[a, pair, wp.vec3(1.0, 2.0, 3.0), True], outputs=[out])

    affine(plain)
    recorded = launching.record(affine, again)
    (command,) = recorded.commands
    command.launch = None  # Warp's own launch is not used
    recorded()
    assert again.numpy().tolist() == plain.numpy().tolist() == [[4.0, 7.0, 10.0], [10.0, 13.0, 16.0]]
    pair.factor = 0.0  # a struct stays as it was at the recording
    recorded()
    assert again.numpy().tolist() == plain.numpy().tolist()


def test_another_kind_of_launch_is_left_to_warp():
    """Warp launches a kernel itself if its recorded launch does not look as it is known."""
    a, out = wp.array([1.0, 2.0], dtype=float, device="cpu"), wp.zeros(2, dtype=float, device="cpu")
    command = launching.record(_launch, a, 2.0, out).commands[0]
    command.block_dim = 2
    assert launching._prepared(command) is None
    del command.block_dim
    assert launching._prepared(command) is None


def test_tape_sees_a_plain_launch():
    """Outside a recording a tape records every launch, also after one with the same arrays was recorded."""
    a = wp.array([1.0, 2.0], dtype=float, device="cpu", requires_grad=True)
    out = wp.zeros(2, dtype=float, device="cpu", requires_grad=True)
    launching.record(_launch, a, 3.0, out)
    with wp.Tape() as tape:
        _launch(a, 3.0, out)
    tape.backward(grads={out: wp.array([1.0, 1.0], dtype=float, device="cpu")})
    assert a.grad.numpy().tolist() == [3.0, 3.0]


def test_recordings_die_with_their_owner():
    """Nothing but the recording keeps its arrays."""
    a, out = (wp.zeros(2, dtype=float, device="cpu") for _ in range(2))
    recorded = launching.record(_launch, a, 2.0, out)
    alive = weakref.ref(a), weakref.ref(out)
    del a, out, recorded
    gc.collect()
    assert [reference() for reference in alive] == [None, None]


def test_a_failed_recording_leaves_launches_plain():
    """After an error in a recording, and in other threads during one, launches happen at once."""
    a, out, other = (wp.full(1, 1.0, dtype=float, device="cpu") for _ in range(3))

    def fails():
        thread = threading.Thread(target=_launch, args=(a, 4.0, other))
        thread.start()
        thread.join()
        raise ValueError

    with pytest.raises(ValueError):
        launching.record(fails)
    _launch(a, 7.0, out)
    assert (out.numpy()[0], other.numpy()[0]) == (7.0, 4.0)


@wp.kernel
def judge_kernel(height: wp.array[float], round: int, least: float, success: wp.array[int], margin: wp.array[float]):
    """Heights above a limit."""
    w = wp.tid()
    margin[w] = height[w] - least
    success[w] = wp.where(margin[w] >= 0.0 and round == 1, 1, 0)


def test_a_wrapper_takes_the_kernels_arguments():
    """Arrays by position or name, flags as numbers, defaults where nothing is given; what is missing is an error."""
    launch_judge = launching.launcher(judge_kernel, least=0.5)
    assert launch_judge.__name__ == "launch_judge" and launch_judge.__doc__ == "Heights above a limit."
    height = wp.array([0.0, 1.0], dtype=float, device="cpu")
    outputs = {"success": wp.zeros(2, dtype=int, device="cpu"), "margin": wp.zeros(2, dtype=float, device="cpu")}
    launch_judge(height, round=True, **outputs)
    assert outputs["success"].numpy().tolist() == [0, 1] and outputs["margin"].numpy().tolist() == [-0.5, 0.5]
    launch_judge(height=height, round=True, least=-1.0, **outputs)
    assert outputs["success"].numpy().tolist() == [1, 1]
    for wrong in ({}, {"round": True, "rond": True}):
        with pytest.raises(TypeError):
            launch_judge(height, **wrong, **outputs)


@wp.kernel
def _number(first: int, factor: float, out: wp.array2d[float]):
    i, j = wp.tid()
    j += first
    out[i, j] += factor * float(10 * i + j + 1)


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_a_divided_launch_is_one_launch(device, threads):
    """Each index of the divided dimension is met once, whatever the number of threads."""
    out = wp.zeros((2, 7), dtype=float, device=device)
    launching.launch_divided(_number, (2, 7), 1, [2.0], [out], threads)
    assert out.numpy().tolist() == [[2.0 * (10 * i + j + 1) for j in range(7)] for i in range(2)]
