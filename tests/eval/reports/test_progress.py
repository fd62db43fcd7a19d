"""Progress counts the ticks of the budget, tells the time left, and stays quiet in a log file."""

import io

import pytest

from arena_newton.eval.reports.progress import Progress, duration, kernels_to_compile


class Clock:
    """Seconds that a test lets pass."""

    now = 0.0

    def __call__(self):
        """The time."""
        return self.now


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self):
        """It is."""
        return True


def run(progress, clock, ticks, worlds, seconds):
    """Ticks of some worlds, evenly over a time."""
    for _ in range(ticks):
        clock.now += seconds / ticks
        progress.tick(worlds)


def test_unused_ticks_count_as_done():
    """An episode that ends early adds what it did not need; the end is exactly the budget."""
    clock, log = Clock(), io.StringIO()
    progress = Progress(1000, planned=2, stream=log, clock=clock)
    progress.group("football base")
    progress.tick(2)
    run(progress, clock, 100, 2, 1.0)
    assert progress.done == 200
    progress.episode(500, 100)
    assert (progress.done, progress.finished) == (600, 1)
    progress.episode(500, 100)
    progress.close()
    assert (progress.done, progress.finished) == (1000, 2)
    assert (
        log.getvalue().splitlines()[-1] == "football base: 2 of 2 episodes, 100% of the tick budget, 200 world-ticks/s"
    )


def test_time_left_leaves_building_out():
    """The time left follows from the time of stepping; building the next environment counts for nothing."""
    clock = Clock()
    progress = Progress(100_000, planned=10, finished=5, done=50_000, stream=io.StringIO(), clock=clock)
    assert progress.seconds_left is None
    for _ in range(2):
        progress.group("boxing base")
        clock.now += 500.0
        progress.tick(10)
        run(progress, clock, 1000, 10, 10.0)
    assert progress.done == 70_000
    assert progress.seconds_left == pytest.approx(30.0)


def test_an_estimate_comes_once():
    """After the first seconds a long run says how long it takes at most; a short one does not."""
    for budget, lines in ((1_000_000, 1), (10_000, 0)):
        clock, log = Clock(), io.StringIO()
        progress = Progress(budget, planned=10, stream=log, clock=clock)
        progress.group("boxing base")
        progress.tick(10)
        run(progress, clock, 600, 10, 6.0)
        said = [line for line in log.getvalue().splitlines() if "at most" in line]
        assert len(said) == lines
        assert all("measured 1000 world-ticks/s: at most 17 min" in line for line in said)


def test_a_log_file_gets_a_line_now_and_then():
    """In a log file a line comes each 30 s or 10 % of the budget, never within 5 s, and none is drawn over."""
    clock, log = Clock(), io.StringIO()
    progress = Progress(100_000, planned=10, stream=log, clock=clock)
    progress.group("boxing base")
    progress.tick(10)
    run(progress, clock, 3000, 10, 300.0)  # 30 % of the budget in 300 s: a line each 30 s
    assert 9 <= log.getvalue().count("% of the tick budget") <= 11
    before = log.getvalue().count("\n")
    run(progress, clock, 6000, 10, 6.0)  # 60 % in 6 s
    assert 1 <= log.getvalue().count("\n") - before <= 2
    assert "\r" not in log.getvalue()


def test_a_terminal_gets_a_bar():
    """On a terminal one bar counts ticks and names episodes, speed and time left."""
    clock, terminal = Clock(), Terminal()
    progress = Progress(10_000, planned=10, stream=terminal, clock=clock)
    progress.group("boxing base")
    progress.tick(10)
    run(progress, clock, 500, 10, 5.0)
    progress.episode(500, 500)
    progress.say("  a line")
    progress.close()
    text = terminal.getvalue()
    assert "boxing base 1/10  50%|" in text and "1000 world-ticks/s, about 5 s left" in text
    assert "  a line\n" in text


def test_compiling_is_foreseen(tmp_path):
    """An empty cache, or one of another device, means that kernels are compiled; a filled one does not."""
    assert kernels_to_compile(tmp_path, "mujoco", "cpu")
    (tmp_path / "wp_arena_newton.kernels.tick_1").mkdir()
    (tmp_path / "wp_arena_newton.kernels.tick_1" / "tick.cpu12.o").touch()
    assert not kernels_to_compile(tmp_path, "mujoco", "cpu")
    assert kernels_to_compile(tmp_path, "warp", "cpu")
    assert kernels_to_compile(tmp_path, "mujoco", "cuda:0")


def test_lengths_of_time():
    """Times are given in the unit that a reader thinks in."""
    assert [duration(s) for s in (0.2, 59, 100, 3600, 12_000)] == ["1 s", "59 s", "2 min", "60 min", "3 h 20 min"]
