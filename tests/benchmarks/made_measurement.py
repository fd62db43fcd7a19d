"""Stands for a measured training: ready at once, five steps per second, or a failure that its flags ask for."""

import json
import sys

frames = json.loads(sys.argv[1])["frames"]
if frames == 666:
    print(json.dumps({"error": "no memory"}), flush=True)
    sys.exit(0)
if frames == 667:
    sys.exit(3)
print("ready", flush=True)
assert sys.stdin.readline() == "go\n"
print(json.dumps({"steps_per_s": 5.0, "memory": 0.0, "graphed": False}), flush=True)
