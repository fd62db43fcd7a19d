"""The package imports the same from a checkout and from a wheel, and shadows nobody."""

import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FLOORS = ("kernels", "trackers", "policies", "eval", "usd_scenes")


def _run(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_checkout_root_does_not_shadow_other_packages():
    """With the checkout root as working directory, `import kernels` does not find our folder of that name."""
    code = "import arena_newton, importlib.util as u; s = u.find_spec('kernels'); print(s.origin if s else 'none')"
    assert str(ROOT) not in _run(code)


def test_floors_import_under_the_package_only():
    """Every floor imports as a submodule."""
    for floor in FLOORS:
        assert _run(f"import arena_newton.{floor} as m; print(m.__name__)") == f"arena_newton.{floor}"


def test_wheel_holds_one_top_level_package(tmp_path):
    """The wheel installs `arena_newton` alone, with every floor and the scenes inside it."""
    import os

    from hatchling.builders.wheel import WheelBuilder

    os.environ["SOURCE_DATE_EPOCH"] = "315532800"
    wheel = next(WheelBuilder(str(ROOT)).build(directory=str(tmp_path), versions=["standard"]))
    names = zipfile.ZipFile(wheel).namelist()
    tops = {n.split("/", 1)[0] for n in names}
    assert {t for t in tops if not t.endswith(".dist-info")} == {"arena_newton"}
    for floor in FLOORS:
        assert f"arena_newton/{floor}/__init__.py" in names
    assert "arena_newton/usd_scenes/football/scene.usda" in names


def test_imports_run_one_way():
    """No floor imports a floor above it."""
    above = {
        "kernels": (
            "arena_newton.trackers",
            "arena_newton.policies",
            "arena_newton.eval",
            "arena_newton.scene",
            "torch",
        ),
        "trackers": ("arena_newton.policies", "arena_newton.eval"),
        "policies": ("arena_newton.eval",),
        "arena_newton": ("arena_newton.trackers", "arena_newton.policies", "arena_newton.eval"),
    }
    for floor, banned in above.items():
        files = [
            p
            for p in (ROOT / floor).rglob("*.py")
            if not any(part in FLOORS for part in p.parts[len(ROOT.parts) + 1 :])
        ]
        for path in files:
            for line in path.read_text().splitlines():
                text = line.strip()
                if text.startswith(("import ", "from ")):
                    parts = text.split()
                    module = parts[1]
                    full = (
                        [module] + [f"{module}.{n.strip(',')}" for n in parts[3:]] if parts[0] == "from" else [module]
                    )
                    bad = [b for b in banned for f in full if f == b or f.startswith(b + ".")]
                    assert not bad, f"{path.relative_to(ROOT)}: {text}"


def test_every_direct_dependency_is_pinned():
    """Direct dependencies are exact, and the resolved set stands in the constraints."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert all("==" in d for d in project["project"]["dependencies"])
    assert len(project["tool"]["uv"]["constraint-dependencies"]) > 50
