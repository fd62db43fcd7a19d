"""A results folder and a suite to compare, of which one file is damaged; see `mutants`."""

import contextlib
import io
import json
import random
import sys
from collections.abc import Callable
from pathlib import Path

from arena_newton.errors import InputError


def comparisons(
    folder: Path, rng: random.Random, damaged: Callable[..., bytes]
) -> tuple[Callable[[Path], None], Callable[[], tuple[str, bytes]]]:
    """A results folder and a suite that are compared, one file of which is damaged; half the faults keep its JSON."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "eval"))
    from made_folders import folder_with
    from made_suites import cell_of, outcomes, write_suite
    from rows import episodes

    from arena_newton.eval.__main__ import main

    rows = [row | {"engine": "mujoco"} for row in episodes("football", (4, 5, 7))]
    flags = {"tracker": ["t"], "task": ["football"], "policy": "p", "engine": "mujoco", "code": "abc"}
    run = folder_with(folder / "run", rows, 60, **flags)
    cells = [(cell_of(p, p, "t", t), outcomes(w)) for p, w in (("a", 20), ("b", 40)) for t in ("football", "boxing")]
    suite = write_suite(folder / "suite", cells)
    names = ("suite.json", "suite.1-of-1.jsonl", f"{cells[0][0].folder}/config.json")
    files = [run / "config.json", run / "episodes.jsonl", *(suite / name for name in names)]
    sound = {path: path.read_bytes() for path in files}
    values = (None, True, 0, -1, 1e308, 10**30, "", "a" * 600, "../x", "<b>", "\u202e", [], ["a", {}], {"a": []})

    def read(path: Path) -> None:
        said = io.StringIO()
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
            code = main(["compare", str(run), str(suite), "--out", str(folder / "out")])
        if code == 2:
            assert said.getvalue().count("\n") == 1, said.getvalue()
            # What two sound files disagree about names what is compared, not a file.
            raise InputError(f"{path}: {said.getvalue()}")
        assert code == 0 and "<b>" not in json.loads((folder / "out" / "compare.json").read_text())["notes"]

    def changed(text: bytes) -> bytes:
        content = json.loads(text)
        nodes, waiting = [], [content]
        while waiting:
            part = waiting.pop()
            inside = list(part) if isinstance(part, dict) else range(len(part))
            nodes += [(part, key) for key in inside]
            waiting += [part[key] for key in inside if isinstance(part[key], dict | list)]
        part, key = rng.choice(nodes)
        if rng.random() < 0.8:
            part[key] = rng.choice(values)
        else:
            del part[key]
        return json.dumps(content).encode()

    def made() -> tuple[str, bytes]:
        for path, data in sound.items():
            path.write_bytes(data)
        path = rng.choice(files)
        name = str(path.relative_to(folder))
        if rng.random() < 0.4:
            return name, damaged(sound[path], rng, text=rng.random() < 0.8)
        if path.suffix == ".json":
            return name, changed(sound[path])
        lines = sound[path].splitlines()
        at = rng.randrange(len(lines))
        lines[at] = changed(lines[at])
        return name, b"\n".join(lines) + b"\n"

    return read, made
