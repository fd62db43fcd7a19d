"""Any program as a policy: it reads a line of JSON for each query and writes one, and may be in any language.

Shows: the protocol of `--policy process:<command>`, whose answers repeat the number of their request. This program
squats and rises, and imports nothing of the package; nothing need be installed but what it runs in.

    python -m arena_newton.eval --task boxing --policy "process:python examples/process_policy.py" --seeds 0 --repeats 2
"""

import json
import math
import sys

LEGS = (-0.2, -0.2, *[0.0] * 7, 0.4, 0.4, 0.0, 0.0, -0.2, -0.2)  # hips ... knees ... ankles, left and right [rad]
STAND = (*LEGS, 0.4, -0.4, *[0.0] * 4, 1.2, 1.2, *[0.0] * 6)  # 29 joints in canonical order


def action(tick: int) -> list[float]:
    """The robot's reference a number of ticks after its episode began: no step, height, upright, joints, open hands."""
    height = 0.8 - 0.05 * (1.0 - math.cos(0.1 * tick))
    return [0.0, 0.0, height, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0, *STAND, 0.0, 0.0]


def answer(asked: dict) -> dict:
    """Answer a request: the policy's name, that an episode may begin, or ten actions."""
    if asked["request"] == "config":
        return {"arena": 1, "needs_picture": False}
    if asked["request"] == "reset":
        return {"seeded": True, "policy": "squat by lines"}  # an episode follows from its own requests alone
    return {"action_chunk": [action(asked["step"] + tick) for tick in range(10)]}


if __name__ == "__main__":
    for line in sys.stdin:
        asked = json.loads(line)
        print(json.dumps(answer(asked) | {"id": asked["id"]}), flush=True)
