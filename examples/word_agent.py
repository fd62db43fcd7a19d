"""An agent that uses only words: it looks at a picture, says where to walk, and a generator moves the robot.

Shows: a program as a policy with pictures as files, and sentences that become actions. `think` is a script for VisNavi;
a language model's answer would stand there. What it says is the transcript, on stderr.

    python examples/word_agent.py --seeds 0 --repeats 1 --out word_agent
"""

import heapq
import json
import math
import sys

import numpy as np
from PIL import Image

from arena_newton.eval.__main__ import main as evaluate
from arena_newton.trackers.motions.words import WordedMotion

HEIGHT, DOWN, WIDE = 1.25, math.radians(52.5), 1.316  # camera of a robot that stands: height [m], pitch, tangent
CELL, LOW, SHAPE = 0.1, np.array([-1.0, -2.5]), (110, 75)  # map of the floor: cells and corner ahead and left [m]
FAR, LEG = 6.0, 2.0  # what is farther is not drawn, and the longest walk between two looks [m]


def look(file: str, x: float, y: float, yaw: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of the floor [n, 2]: where it is free, at the feet of red things, and at what is yellow."""
    picture = np.asarray(Image.open(file)).astype(int)
    red, green, blue = np.moveaxis(picture, 2, 0)
    rows, columns = np.mgrid[: len(red), : red.shape[1]] * 2 + 1
    right, up = (columns / red.shape[1] - 1) * WIDE, (1 - rows / len(red)) * WIDE * len(red) / red.shape[1]
    away = HEIGHT / np.maximum(math.sin(DOWN) - up * math.cos(DOWN), 1e-3)
    ahead, left = 0.09 + away * (math.cos(DOWN) + up * math.sin(DOWN)), -away * right
    turned = ahead * math.cos(yaw) - left * math.sin(yaw), ahead * math.sin(yaw) + left * math.cos(yaw)
    floor, near = np.stack(turned, axis=2) + (x, y), np.hypot(ahead, left) < FAR
    grey = (np.ptp(picture, axis=2) < 15) & (red > 140) & (red < 185)
    feet = (red - green > 30) & (red > 100) & np.roll(grey, -2, axis=0)
    paint = (red - blue > 80) & (green - blue > 60) & (ahead < 8)
    return floor[grey & near], floor[feet & near], floor[paint]


def cells(points: np.ndarray) -> tuple[np.ndarray, ...]:
    """Cells of the map that points lie in, without those outside."""
    found = ((points - LOW) / CELL).astype(int)
    return tuple(found[((found >= 0) & (found < SHAPE)).all(axis=1)].T)


def route(cost: np.ndarray, start: tuple[int, int], goal: tuple[int, int]) -> list[tuple[int, int]]:
    """Cheapest way over the cells, by Dijkstra from the goal."""
    rest, then, queue = np.full(SHAPE, np.inf), {}, [(0.0, goal, goal)]
    while queue:
        so_far, cell, after = heapq.heappop(queue)
        if so_far >= rest[cell]:
            continue
        rest[cell], then[cell] = so_far, after
        for step in ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (1, -1), (-1, 1), (-1, -1)):
            i, j = cell[0] + step[0], cell[1] + step[1]
            if 0 <= i < SHAPE[0] and 0 <= j < SHAPE[1]:
                more = so_far + math.hypot(*step) * cost[i, j]
                if more < rest[i, j]:
                    heapq.heappush(queue, (more, (i, j), cell))
    way = [start]
    while way[-1] != goal:
        way.append(then[way[-1]])
    return way


class Agent:
    """One robot: its motion, and what it remembers."""

    def __init__(self) -> None:
        """Stand, and know of no goal."""
        self.motion, self.goal, self.said = WordedMotion(), np.array([1.0, 0.0]), np.zeros(2)
        self.blocked = np.zeros(SHAPE, bool)

    def think(self, file: str) -> np.ndarray:
        """A point: as far as is free on the way to the near edge of the yellow area, around what is red."""
        here = np.array(self.motion.pose[:2])
        free, feet, paint = look(file, *self.motion.pose)
        self.blocked[cells(free)] = False
        self.blocked[cells(feet)] = True
        away = np.linalg.norm(paint - here, axis=1)
        if len(away) and away.min() > 0.6:
            near = paint[away < away.min() + 0.4].mean(axis=0) - here
            self.goal = here + near / np.linalg.norm(near) * (away.min() + 0.3)
        centres = np.moveaxis(np.indices(SHAPE), 0, 2) * CELL + LOW + CELL / 2
        red = centres[self.blocked & (np.linalg.norm(centres - self.goal, axis=2) > 0.3)]
        gap = np.min([np.linalg.norm(centres - one, axis=2) for one in [*red, (99.0, 99.0)]], axis=0)
        cost = 1.0 + 60.0 * (gap < 0.4) + 6.0 * (gap < 0.55) + (gap < 0.7)
        ends = np.clip((np.stack([here, self.goal]) - LOW) / CELL, 0, np.array(SHAPE) - 1).astype(int).tolist()
        way = route(cost, (ends[0][0], ends[0][1]), (ends[1][0], ends[1][1]))
        for cell in way[::-1]:
            point = self.goal if cell == way[-1] else centres[cell]
            line = here + np.linspace(0, 1, 40)[:, None] * (point - here)
            dearest = max(cost[one] for one in way[: way.index(cell) + 1])
            if math.dist(point, here) < LEG and cost[cells(line)].max() <= dearest:
                break
        return point

    def act(self, asked: dict) -> list[list[float]]:
        """Half a second of motion; once a second it looks, and says where to go if that is elsewhere now."""
        if asked["step"] % 50 == 0:
            point = self.think(asked["observation"]["images"]["front"]["file"])
            if math.dist(point, self.said) > 0.25:
                self.said, sentence = point, f"walk to {point[0]:.2f} {point[1]:.2f}"
                print(f"world {asked['world']} {asked['step'] * 0.02:5.1f} s  {sentence}", file=sys.stderr, flush=True)
                self.motion.say(sentence)
        state = asked["observation"]["state"]
        return self.motion.actions(25, math.atan2(state[2], state[0]))


if __name__ == "__main__":
    agents: dict[int, Agent] = {}
    for line in sys.stdin if sys.argv[1:] == ["answer"] else ():
        asked = json.loads(line)
        reply = {"id": asked["id"], "seeded": True, "policy": "words", "picture_files": True}
        if asked["request"] == "reset":
            agents[asked["world"]] = Agent()
        elif asked["request"] == "infer":
            reply["action_chunk"] = agents[asked["world"]].act(asked)
        print(json.dumps(reply), flush=True)
    if sys.argv[1:] != ["answer"]:
        flags = f"--task vis_navi --tracker twist2 --engine mujoco {' '.join(sys.argv[1:])}"
        evaluate([*flags.split(), "--policy", f"process:{sys.executable} {__file__} answer"])
