"""A program as a policy, as a package: the command `squat` reads a line of JSON for each query, and writes one.

Shows: the protocol of `--policy process:<command>`, whose answers repeat the number of their request. Nothing of
arena-newton is imported: any language will do. More: docs/howto/bring/policy_server.md.

    uv pip install -e examples/new_program
    python -m arena_newton.eval --task boxing --policy process:squat --seeds 0 --repeats 2
"""

import hashlib
import json
import math
import sys
from pathlib import Path

LEGS = (-0.2, -0.2, *[0.0] * 7, 0.4, 0.4, 0.0, 0.0, -0.2, -0.2)  # hips ... knees ... ankles, left and right [rad]
STAND = (*LEGS, 0.4, -0.4, *[0.0] * 4, 1.2, 1.2, *[0.0] * 6)  # 29 joints in canonical order
NAME = f"squat {hashlib.sha256(Path(__file__).read_bytes()).hexdigest()[:8]}"  # what results know of its code


def answer(asked: dict) -> dict:
    """Answer a request: what it needs, that an episode may begin, or ten actions."""
    if asked["request"] == "config":
        return {"arena": 1, "needs_picture": False}
    if asked["request"] == "reset":
        return {"seeded": True, "policy": NAME}  # an episode follows from its own requests alone
    heights = [0.8 - 0.05 * (1.0 - math.cos(0.1 * (asked["step"] + tick))) for tick in range(10)]
    return {"action_chunk": [[0.0, 0.0, height, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0, *STAND, 0.0, 0.0] for height in heights]}


def main() -> None:
    """Answer until the input ends."""
    for line in sys.stdin:
        asked = json.loads(line)
        print(json.dumps(answer(asked) | {"id": asked["id"]}), flush=True)
