"""Training of trackers: PPO (rsl_rl) on Newton's MuJoCo solver, one environment for all interfaces."""

import os

# rsl_rl notes the commit of a run with GitPython, which refuses to be imported where git is not installed.
os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")
