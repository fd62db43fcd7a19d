"""HumanoidArena on Newton/Warp.

A policy decides a 40D whole-body action, a tracker executes it, a world moves, a rule judges.
"""

import sys
from pathlib import Path

__version__ = "0.1.0"

_CHECKOUT = Path(__file__).resolve().parent.parent
# The checkout root holds a folder `kernels/`, which would shadow the package of that name that transformers imports.
if (_CHECKOUT / "pyproject.toml").is_file() and (_CHECKOUT / "kernels").is_dir():
    sys.path[:] = [p for p in sys.path if Path(p or ".").resolve() != _CHECKOUT]
