"""An agent that uses only words: it looks at a picture, says where to walk, and a generator moves the robot.

Shows: a program as a policy with pictures as files, and sentences that become actions. `think` is a script for VisNavi;
a language model's answer would stand there. What it says is the transcript, on stderr.

    python examples/word_agent.py --seeds 0 --repeats 1 --out word_agent
"""

import json
import math
import sys

import numpy as np
import torch
from PIL import Image

from arena_newton.eval.__main__ import main as evaluate
from arena_newton.policies.experts.planning import Floor, plan
from arena_newton.trackers.motions.words import WordedMotion

HEIGHT, DOWN, WIDE = 1.25, math.radians(52.5), 1.316  # camera of a robot that stands: height [m], pitch, tangent
CELL, ROOM = 0.3, ((-1.0, -2.5), (10.0, 5.0))  # grid of obstacles, and corners of the floor, ahead and left [m]


def look(file: str, x: float, y: float, yaw: float) -> tuple[np.ndarray, np.ndarray]:
    """Points of the floor [n, 2] at the feet of red things, and at what is yellow."""
    red, green, blue = np.moveaxis(np.asarray(Image.open(file)).astype(int), 2, 0)
    rows, columns = np.mgrid[: len(red), : red.shape[1]] * 2 + 1
    right, up = (columns / red.shape[1] - 1) * WIDE, (1 - rows / len(red)) * WIDE * len(red) / red.shape[1]
    far = HEIGHT / np.maximum(math.sin(DOWN) - up * math.cos(DOWN), 1e-3)
    ahead, left = 0.09 + far * (math.cos(DOWN) + up * math.sin(DOWN)), -far * right
    turned = ahead * math.cos(yaw) - left * math.sin(yaw), ahead * math.sin(yaw) + left * math.cos(yaw)
    floor, block = np.stack(turned, axis=2) + (x, y), (red - green > 30) & (red > 100) & (ahead < 8)
    paint = (red - blue > 80) & (green - blue > 60) & (ahead < 8)
    return floor[block & ~np.roll(block, -1, axis=0)], floor[paint]


class Agent:
    """One robot: its motion, and what it remembers."""

    def __init__(self) -> None:
        """Stand, and know of no goal."""
        self.motion, self.goal, self.waited = WordedMotion(), np.array([1.0, 0.0]), 0
        self.blocks = np.zeros((0, 2))

    def think(self, file: str) -> str:
        """A sentence: to the next corner of a path to the near edge of the yellow area, around what is red."""
        here = np.array(self.motion.pose[:2])
        blocks, paint = look(file, *self.motion.pose)
        self.blocks = np.unique(np.concatenate([self.blocks, (blocks / CELL).round()]), axis=0)
        away = np.linalg.norm(paint - here, axis=1)
        if len(away) and away.min() > 1.0:
            near = paint[away < away.min() + 0.5].mean(axis=0) - here
            self.goal = here + near / np.linalg.norm(near) * (away.min() + 0.27)
        boxes = [[*block * CELL, 0.0, 0.1, 0.1] for block in self.blocks if math.dist(block * CELL, self.goal) > 0.5]
        start, end = (torch.tensor(point[None], dtype=torch.float32) for point in (here, self.goal))
        found = plan(start, end, Floor(torch.tensor([boxes]).reshape(1, -1, 5), *ROOM))
        if found.clearance[0] == 0.0:
            print("       sees no free path, looks again from nearer", file=sys.stderr)
            found.points[0, :] = start + 0.15 * (end - start)
        path = found.points[0].tolist()
        corner = next((point for point in path if math.dist(point, here) > 0.3), path[-1])
        return f"walk to {corner[0]:.2f} {corner[1]:.2f}"

    def act(self, asked: dict) -> list[list[float]]:
        """Half a second of motion; a new sentence once the robot has stood for a second."""
        self.waited = self.waited + 1 if self.motion.arrived else 0
        if self.waited > 2:
            sentence = self.think(asked["observation"]["images"]["front"]["file"])
            print(f"{asked['step'] * 0.02:5.1f} s  {sentence}", file=sys.stderr, flush=True)
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
