"""``data inspect``: episodes as one page that needs nothing else: figures, outliers, phases, curves and film strips.

The page's template (`page/inspect.html`) escapes every text, and its Content-Security-Policy lets nothing be loaded and
no script run: pictures are in it, and its style is named by its hash.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import av
import cv2
import numpy as np
from markupsafe import Markup
from tqdm import tqdm

from arena_newton.data.checks.episode_figures import FIGURES, EpisodeFigures, figures, ranked
from arena_newton.data.datasets.motion_source import Motion, motions
from arena_newton.data.readers.frame_reader import OpenVideo
from arena_newton.errors import InputError
from arena_newton.files.own_files import replace_atomically
from arena_newton.files.text import counted
from arena_newton.pages.html import EMBEDDED, render
from arena_newton.pictures.video import evenly
from arena_newton.robot import g1
from arena_newton.robot.canonical import ACTION, HAND_CLOSED, STATE

if TYPE_CHECKING:
    from arena_newton.data.datasets.data_options import InspectOptions

__all__ = ["inspect", "page"]

POINTS = 400
"""Points of a curve."""
STRIP_HEIGHT = 110
"""Height of a film strip's pictures [px]."""
GAP = 2
"""Space between them [px]."""
QUALITY = 82
"""Quality of their JPEG."""
WIDTH, HEIGHT = 1000, 120
"""Size of a panel of curves, in its own units."""
COLOURS = 8
"""Colours of phases and curves in the style (`c0` ... `c7`)."""
JOINT_GROUPS = {
    "left leg": ("left_hip", "left_knee", "left_ankle"),
    "right leg": ("right_hip", "right_knee", "right_ankle"),
    "waist": ("waist",),
    "left arm": ("left_shoulder", "left_elbow", "left_wrist"),
    "right arm": ("right_shoulder", "right_elbow", "right_wrist"),
}
"""Panels of joints by the beginnings of their names."""


@dataclass(frozen=True)
class Curve:
    """One line of a panel."""

    name: str
    points: Markup
    """Points as `polyline` takes them."""
    colour: int
    faint: bool = False
    """True for the measured values, drawn behind the commanded ones."""


@dataclass(frozen=True)
class Panel:
    """Curves on one scale."""

    title: str
    curves: tuple[Curve, ...]
    low: float
    high: float

    @property
    def legend(self) -> list[Curve]:
        """Curves that are named: those that were asked for, and what was measured where it has no name of those."""
        asked = [curve for curve in self.curves if not curve.faint]
        names = {curve.name for curve in asked}
        return asked + [curve for curve in self.curves if curve.name not in names]


@dataclass(frozen=True)
class Shown:
    """An episode in full."""

    motion: Motion
    figures: EpisodeFigures
    strip: Markup
    """JPEG as text of base 64; empty without a video."""
    times: tuple[str, ...]
    """Times of the strip's pictures."""
    bands: tuple[tuple[str, int, float, float], ...]
    """Phases: name, colour, begin and width in units of the panel."""
    panels: tuple[Panel, ...]

    @property
    def phases(self) -> list[tuple[str, int]]:
        """Phases and their colours, in the order of their first appearance."""
        return list({name: colour for name, colour, *_ in self.bands}.items())


def inspect(folders: Sequence[Path], options: InspectOptions) -> int:
    """Write the page.

    Returns:
        Exit code 0.

    Raises:
        InputError: A folder holds no episodes, or one is damaged.
        InputError: The page cannot be written.
    """
    if options.episodes < 1:
        raise InputError(f"--episodes {options.episodes}: expected at least 1")
    if not 2 <= options.pictures <= 40:
        raise InputError(f"--pictures {options.pictures}: expected 2 to 40")
    if not 0 <= options.looks <= 100:
        raise InputError(f"--looks {options.looks}: expected 0 to 100")
    found = figures(motions(folders))
    order = {id(one): rank for rank, one in enumerate(ranked(found))}
    chosen = {number for number, one in enumerate(found) if order[id(one)] < options.episodes}
    shown = []
    bar = tqdm(total=len(chosen), unit="episode", desc="inspect", disable=None, dynamic_ncols=True)
    with bar:
        for number, motion in enumerate(motions(folders)):
            if number in chosen:
                shown.append(_shown(motion, found[number], options.pictures, options.looks))
                bar.update()
    text = page(found, shown, ", ".join(folder.name for folder in folders))
    out = options.out.expanduser()
    try:
        with replace_atomically(out) as file:
            file.write(text.encode())
    except OSError as error:
        raise InputError(f"--out {out}: cannot be written ({error.strerror or error})") from error
    print(f"{out}: {counted(len(found), 'episode')}, {len(shown)} of them in full, {len(text) / 2**20:.1f} MiB")
    return 0


def page(found: Sequence[EpisodeFigures], shown: Sequence[Shown], title: str) -> str:
    """The page as HTML.

    Args:
        found: Figures of all episodes.
        shown: Those in full, in their order.
    """
    anchors = {id(one.figures): f"#episode{number}" for number, one in enumerate(shown)}
    groups: dict[tuple[str, str], list[EpisodeFigures]] = {}
    for one in found:
        groups.setdefault((one.task, one.tracker), []).append(one)
    medians = {
        key: {name: float(np.median([getattr(one, name) for one in members])) for name in FIGURES}
        for key, members in groups.items()
    }
    return render(
        Path(__file__).parent / "page" / "inspect.html",
        styles=["inspect.css"],
        sources=EMBEDDED,
        title=title,
        found=[(one, anchors.get(id(one), "")) for one in ranked(found)],
        groups=groups,
        medians=medians,
        figures=FIGURES,
        shown=shown,
        width=WIDTH,
        height=HEIGHT,
        rows=sum(one.rows for one in found),
    )


def _shown(motion: Motion, about: EpisodeFigures, count: int, looks: int) -> Shown:
    picks = evenly(motion.rows, count)
    if looks and motion.looks is not None:
        picks = [pick - pick % motion.looks[0].stride for pick in picks]
    strip = Markup("") if motion.video is None else _strip(motion, picks, looks)
    times = tuple(f"{pick * g1.TICK:.1f} s" for pick in picks)
    return Shown(motion, about, strip, times, _bands(motion), tuple(_panels(motion)))


def _strip(motion: Motion, picks: Sequence[int], looks: int) -> Markup:
    """Pictures next to each other as a JPEG, and rows of them under changed looks."""
    try:
        video = OpenVideo(Path(motion.video or ""))
        try:
            frames = [video.read(motion.first + pick) for pick in picks]
        finally:
            video.close()
        rows = [frames]
        if looks and motion.looks is not None:
            from arena_newton.data.checks.look_sheet import changed_rows  # which loads torch

            rows += changed_rows(frames, picks, *motion.looks, looks)
    except (av.error.FFmpegError, OSError, IndexError, AttributeError) as error:  # a stream without a codec is None
        name = getattr(error, "filename", None) or ""  # of an error in decoding the name of FFmpeg's function
        name = name if Path(name).is_file() else motion.video
        raise InputError(f"{name}: not a readable video ({type(error).__name__})") from error
    height = frames[0].shape[0]
    size = max(1, round(frames[0].shape[1] * STRIP_HEIGHT / height)), STRIP_HEIGHT
    how = cv2.INTER_AREA if height > STRIP_HEIGHT else cv2.INTER_NEAREST
    gap = np.full((STRIP_HEIGHT, GAP, 3), 128, np.uint8)
    strips = []
    for row in rows:
        parts = [part for one in row for part in (cv2.resize(one, size, interpolation=how), gap)]
        strips.append(np.concatenate(parts[:-1], axis=1))
    strip = cv2.cvtColor(np.concatenate(strips), cv2.COLOR_RGB2BGR)
    encoded = cv2.imencode(".jpg", strip, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1]
    return Markup(base64.b64encode(encoded.tobytes()).decode())


def _bands(motion: Motion) -> tuple[tuple[str, int, float, float], ...]:
    """Phases as intervals."""
    names = {name: number % COLOURS for number, name in enumerate(dict.fromkeys(motion.phases))}
    starts = [0, *(row for row in range(1, len(motion.phases)) if motion.phases[row] != motion.phases[row - 1])]
    ends = [*starts[1:], len(motion.phases)]
    unit = WIDTH / max(1, motion.rows)
    return tuple(
        (motion.phases[a], names[motion.phases[a]], round(a * unit, 1), round((b - a) * unit, 1))
        for a, b in zip(starts, ends, strict=True)
        if motion.phases and motion.phases[a]
    )


def _panels(motion: Motion) -> list[Panel]:
    """Curves of the root, then of each group of joints."""
    action, state = motion.action, motion.state
    rotation = action[:, ACTION["root_rot6d"]]
    measured = state[:, STATE["root_rot6d"]]
    speed = action[:, ACTION["root_xy_delta"]] / g1.TICK
    hands = action[:, ACTION["hands"]] >= HAND_CLOSED
    found = [
        _panel("reference velocity [m/s]", [("forward", speed[:, 0]), ("left", speed[:, 1])], []),
        _panel("reference height [m]", [("height", action[:, ACTION["root_z"].start])], []),
        _panel("heading [rad]", [("reference", _yaw(rotation))], [("measured", _yaw(measured))]),
    ]
    if hands.any():
        closed = [(side, hands[:, number].astype(float)) for number, side in enumerate(("left", "right"))]
        found.append(_panel("hands closed", closed, [], (-0.1, 1.1)))
    for title, beginnings in JOINT_GROUPS.items():
        numbers = [n for n, joint in enumerate(g1.CANONICAL_JOINTS) if joint.startswith(beginnings)]
        names = [g1.CANONICAL_JOINTS[n].removesuffix("_joint").replace("_", " ") for n in numbers]
        names = [name.removeprefix(title.split()[0] + " ") for name in names]
        asked = [(name, action[:, ACTION["joint_pos"]][:, n]) for name, n in zip(names, numbers, strict=True)]
        seen = [(name, state[:, STATE["joint_pos"]][:, n]) for name, n in zip(names, numbers, strict=True)]
        found.append(_panel(f"{title} [rad]", asked, seen))
    return found


def _yaw(rot6d: np.ndarray) -> np.ndarray:
    """Heading without jumps [rad]."""
    return np.unwrap(np.arctan2(rot6d[:, 2], rot6d[:, 0]).astype(np.float64))


def _panel(
    title: str,
    curves: Sequence[tuple[str, np.ndarray]],
    behind: Sequence[tuple[str, np.ndarray]],
    scale: tuple[float, float] | None = None,
) -> Panel:
    """Curves over those behind them, on a scale that fits all where none is given."""
    every = np.concatenate([values for _, values in (*curves, *behind)]).astype(np.float64)
    low, high = scale or (float(every.min()), float(every.max()))
    low, high = (low - 0.05, high + 0.05) if high - low < 0.1 else (low, high)
    picks = np.array(evenly(len(curves[0][1]), POINTS))
    x = picks * (WIDTH / max(1, len(curves[0][1]) - 1))

    def line(values: np.ndarray) -> Markup:
        y = HEIGHT - (np.asarray(values, np.float64)[picks] - low) / (high - low) * HEIGHT
        return Markup(" ".join(f"{a:.0f},{b:.1f}" for a, b in zip(x, y, strict=True)))

    lines = [Curve(name, line(values), n % COLOURS, True) for n, (name, values) in enumerate(behind)]
    lines += [Curve(name, line(values), n % COLOURS) for n, (name, values) in enumerate(curves)]
    return Panel(title, tuple(lines), low, high)
