"""What a training of ACT imports before it begins."""

import subprocess
import sys


def test_lerobot_comes_without_what_nobody_uses():
    """The training's modules are there, scikit-learn is not; whoever asks transformers for it is told the truth."""
    code = (
        "import sys\n"
        "from arena_newton.policies.train.lean_import import import_lerobot\n"
        "import_lerobot()\n"
        "import arena_newton.policies.train.training, arena_newton.policies.train.act_family\n"
        "from transformers.utils import is_sklearn_available\n"
        "print('sklearn' in sys.modules, 'lerobot.policies.factory' in sys.modules, is_sklearn_available())\n"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=True)
    assert found.stdout.split() == ["False", "True", "True"]
