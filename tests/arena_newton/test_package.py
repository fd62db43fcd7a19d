"""The package imports the same from a checkout and from a wheel, and shadows nobody."""

import logging
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from arena_newton.cli.extras import require

ROOT = Path(__file__).resolve().parents[2]
FLOORS = ("kernels", "trackers", "policies", "eval", "usd_scenes")


def _run(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_checkout_root_does_not_shadow_other_packages():
    """With the checkout root as working directory, `import kernels` does not find our folder of that name."""
    code = "import arena_newton, importlib.util as u; s = u.find_spec('kernels'); print(s.origin if s else 'none')"
    assert str(ROOT) not in _run(code)


def test_floors_import_under_the_package_only():
    """Every floor imports as a submodule."""
    names = [f"arena_newton.{floor}" for floor in FLOORS]
    assert _run(f"import sys, {', '.join(names)}; print(*({{*{FLOORS}}} & set(sys.modules)))") == ""


def test_public_names():
    """The package's names are these, each imports at its first use, and none loads a library before."""
    import arena_newton

    assert arena_newton.__all__ == [
        *("ArenaEnv", "Camera", "CameraConfig", "EpisodeRecorder", "Rollout", "__version__", "canonical"),
        *("differentiable", "policies", "rule_sets", "rules", "tasks", "trackers"),
    ]
    assert all(getattr(arena_newton, name) is not None for name in arena_newton.__all__)
    assert set(arena_newton.__all__) <= set(dir(arena_newton))
    heavy = "{'numpy', 'torch', 'warp', 'newton', 'mujoco', 'pxr'} & set(sys.modules)"
    assert _run(f"import arena_newton, sys; print(sorted({heavy}))") == "[]"
    with pytest.raises(AttributeError, match="nothing"):
        _ = arena_newton.nothing


def test_wheel_holds_one_top_level_package(tmp_path):
    """The wheel installs `arena_newton` alone, with every floor and the scenes inside it, and a registry takes it."""
    import os

    from hatchling.builders.wheel import WheelBuilder

    os.environ["SOURCE_DATE_EPOCH"] = "315532800"
    wheel = next(WheelBuilder(str(ROOT)).build(directory=str(tmp_path), versions=["standard"]))
    assert Path(wheel).stat().st_size <= 95e6, "a registry takes 100 MB"
    names = zipfile.ZipFile(wheel).namelist()
    tops = {n.split("/", 1)[0] for n in names}
    assert {t for t in tops if not t.endswith(".dist-info")} == {"arena_newton"}
    for floor in FLOORS:
        assert f"arena_newton/{floor}/__init__.py" in names
    assert "arena_newton/usd_scenes/football/scene.usda" in names
    assert "arena_newton/py.typed" in names
    assert {f"arena_newton/eval/suites/{name}.toml" for name in ("paper", "tiny")} <= set(names)
    assert {f"arena_newton/eval/reports/page/report.{ending}" for ending in ("html", "css", "js")} <= set(names)


def test_dependencies_have_both_ends_and_a_tested_version():
    """Direct dependencies are ranges with both ends, and the exact versions of the whole set satisfy them."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    exact = {}
    for line in project["tool"]["uv"]["constraint-dependencies"]:
        name, _, version = line.partition("==")
        exact[name] = version
    assert len(exact) > 50
    extras = [line for lines in project["project"]["optional-dependencies"].values() for line in lines]
    for line in [*project["project"]["dependencies"], *extras]:
        wanted = Requirement(line)
        ends = {part.operator for part in wanted.specifier}
        assert ends in ({">=", "<"}, {"=="}), line
        assert wanted.specifier.contains(exact[wanted.name]), line


def test_the_package_says_what_it_is():
    """Types are offered to checkers, package and citation name one version, and the console script is declared."""
    import arena_newton

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert (ROOT / "arena_newton" / "py.typed").read_bytes() == b""
    assert arena_newton.__version__ == project["version"]
    citation = (ROOT / "CITATION.cff").read_text()
    assert f"version: {project['version']}" in citation and "2606.17833" in citation
    assert project["scripts"] == {"arena-newton": "arena_newton.__main__:main"}


def test_the_container_is_linted_and_pinned():
    """A linter finds nothing in the Dockerfile (untagged base, last user root), which installs the versions tested."""
    linter = shutil.which("hadolint", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    if linter is None:
        pytest.skip("needs the group dev: hadolint is not installed")
    found = subprocess.run([linter, "--no-color", ROOT / "Dockerfile"], capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stdout + found.stderr
    installed = re.findall(r"\S+==\S+", (ROOT / "Dockerfile").read_text())
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert len(installed) == 3 and set(installed) <= set(project["tool"]["uv"]["constraint-dependencies"])


def test_a_missing_torchcodec_is_no_page_of_tracebacks():
    """LeRobot's warning of it is silenced by what needs LeRobot; its other warnings are not."""
    require("data", "a test")
    logger = logging.getLogger("lerobot.utils.import_utils")

    def shown(message: str) -> bool:
        return bool(logger.filter(logger.makeRecord(logger.name, logging.WARNING, "", 0, message, (), None)))

    assert not shown("Could not load libtorchcodec. Likely causes:\n" + 40 * "line\n")
    assert shown("another matter")
