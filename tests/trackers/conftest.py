"""Lets the tests of this folder import the networks they are made with."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
