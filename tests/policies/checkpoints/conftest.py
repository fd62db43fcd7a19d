"""A tiny checkpoint of each family, once per process."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
from made_checkpoints import facts, install, made_clip, save


@pytest.fixture(scope="module", autouse=True)
def narrow(narrow_resnet):
    """Checkpoints of this folder are small."""


@pytest.fixture(scope="session")
def checkpoints(tmp_path_factory):
    """Family → folder of a checkpoint; `two` is a Diffusion Policy that looks at two ticks."""
    root = tmp_path_factory.mktemp("checkpoints")
    clip = made_clip(root / "clip")
    with pytest.MonkeyPatch.context() as patch:
        install(patch)
        found = {name: save(root / name, name, facts=facts(family=name)) for name in ("act", "diffusion")}
        found["two"] = save(root / "two", "diffusion", facts=facts(family="diffusion"), n_obs_steps=2)
    found["flow"] = save(root / "flow", "flow", clip=clip, facts=facts(family="flow"))
    return found
