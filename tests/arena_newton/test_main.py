"""One command line for everything: it finds each command, answers at once and keeps exit codes."""

import errno
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from arena_newton.__main__ import COMMANDS, main
from arena_newton.cli.command_line import exit_code
from arena_newton.eval import __main__ as evaluation

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = Path(sys.executable).with_name("arena-newton")


def test_every_program_of_the_package_has_a_command():
    """Modules that `python -m` runs are the commands'; builders, examples, processes of commands and doors aside."""
    doors = {
        "arena_newton/__main__.py",
        "arena_newton/files/sandboxed_load.py",
        "arena_newton/data/recording/encoder_process.py",
        "eval/workers/local_backend.py",
        "policies/train/frames/decoder_process.py",
        "trackers/__main__.py",
    }
    programs = set()
    for folder in ("arena_newton", "kernels", "trackers", "policies", "eval", "usd_scenes"):
        for path in (ROOT / folder).rglob("*.py"):
            name = path.resolve().relative_to(ROOT).as_posix()
            if 'if __name__ == "__main__":' in path.read_text() and name not in doors and "example" not in name:
                programs.add("arena_newton." + name.removeprefix("arena_newton/")[:-3].replace("/", "."))
    assert programs == {command.module for command in COMMANDS}


INTERRUPTING = """import os, signal, sys
class Finder:
    def find_spec(self, name, path, target=None):
        if name == os.environ["INTERRUPTED_AT"]:
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Finder())
"""


@pytest.mark.parametrize("at", ["arena_newton.cli.command_line", "arena_newton.eval.__main__", "arena_newton.tasks"])
def test_an_interrupted_import_is_one_word(tmp_path, at):
    """Ctrl-C while a command's own modules are imported, before it can catch it, is no traceback, and code 130."""
    (tmp_path / "sitecustomize.py").write_text(INTERRUPTING)
    command = [sys.executable, "-m", "arena_newton.eval", "list", "--task", "football"]
    variables = os.environ | {"PYTHONPATH": str(tmp_path), "INTERRUPTED_AT": at}
    done = subprocess.run(command, env=variables, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr.strip(), done.stdout) == (130, "interrupted", "")


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.words)
def test_every_command_explains_itself(command, capsys):
    """`--help` behind each command's words is the command's own and ends with 0."""
    try:
        code = main([*command.words.split(), "--help"])
    except SystemExit as stop:  # of argparse and tyro
        code = stop.code
    assert code == 0
    assert capsys.readouterr().out.count("\n") > 1


def test_the_overview_names_every_command_of_eval(capsys):
    """The one line on `eval` names all of its commands."""
    assert main(["--help"]) == 0
    (names,) = re.findall(r"^  arena-newton eval +evaluate: (.*)$", capsys.readouterr().out, re.M)
    assert names.split() == list(evaluation.COMMANDS)


def test_help_answers_in_the_name_of_the_call():
    """Help names the program as it was called, and shows no default where a list has none."""
    calls = {
        ("-m", "arena_newton", "eval"): "python -m arena_newton eval",
        ("-m", "arena_newton.eval"): "python -m arena_newton.eval",
    }
    calls |= {(str(SCRIPT), "eval"): "arena-newton eval"}
    for call, name in calls.items():
        shown = subprocess.run([sys.executable, *call, "--help"], capture_output=True, text=True, check=True).stdout
        assert f"usage: {name} run" in shown and f"  {name} resume" in shown
        assert "(default: )" not in shown and "(default: paper)" in shown


def test_arguments_and_exit_codes_pass(tmp_path, capsys):
    """A command gets what stands behind its words, and its exit code is the answer."""
    assert main(["eval", "list", "--task", "boxing", "--seeds", "4", "--repeats", "2", "--json"]) == 0
    plan = json.loads(capsys.readouterr().out)
    assert [(row["task"], row["repeat"]) for row in plan] == [("boxing", 0), ("boxing", 1)]
    assert main(["scenes", "validate", str(tmp_path / "none.usda")]) == 2
    assert main(["trackers", "evaluate"]) == 2
    assert main(["trackers", "motions", "inspect", str(tmp_path / "none.npz")]) == 2
    assert main(["train", "--worlds", "-1", "--device", "cpu"]) == 2


def test_what_is_no_command_is_named(capsys):
    """Unknown words and surplus arguments are one line and 2; groups and nothing at all show the overview."""
    for arguments in (["evl"], ["trackers", "nothing"], ["evl", "--help"], ["rules", "--x"], ["doctor", "--x"]):
        assert main(arguments) == 2
        error = capsys.readouterr().err
        assert error.startswith("error: ") and error.count("\n") == 1 and any(word in error for word in arguments)
    assert main([]) == main(["trackers"]) == 2
    shown = capsys.readouterr()
    assert not shown.out and all(shown.err.count(f"arena-newton {c.words} ") for c in COMMANDS)
    assert main(["trackers", "--help"]) == 0
    out = capsys.readouterr().out
    assert "trackers motions" in out and "doctor" not in out


def test_the_overview_imports_nothing_heavy():
    """The overview and the listing of trackers' commands come from the standard library alone."""
    code = (
        "import sys; from arena_newton.__main__ import main; main(['--help']); main(['trackers', '--help'])\n"
        "heavy = {'numpy', 'torch', 'warp', 'newton', 'tyro', 'mujoco', 'pxr', 'lerobot'} & set(sys.modules)\n"
        "print('heavy:', sorted(heavy))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=500, cwd=ROOT)
    assert done.returncode == 0 and done.stdout.endswith("heavy: []\n")


@pytest.mark.parametrize(
    "start", [[str(SCRIPT)], [sys.executable, "-m", "arena_newton"], [sys.executable, "-m", "arena_newton.trackers"]]
)
def test_installed_commands_run_from_any_folder(start, tmp_path):
    """Console script and modules answer from another folder; output that nobody reads on is no error."""
    done = subprocess.run([*start, "--help"], capture_output=True, text=True, timeout=500, cwd=tmp_path)
    assert done.returncode == 0 and "arena-newton trackers train" in done.stdout and not done.stderr
    wrong = subprocess.run([*start, "nothing"], capture_output=True, text=True, timeout=500, cwd=tmp_path)
    assert wrong.returncode == 2 and wrong.stderr.count("\n") == 1


def test_a_command_ends_without_a_search_for_garbage():
    """Garbage is looked for rarely, and what a command leaves is frozen at the interpreter's end: both take seconds."""
    code = (
        "import atexit, gc\n"
        "from arena_newton.cli.command_line import exit_code\n"
        "before = gc.get_freeze_count()\n"
        "atexit.register(lambda: print(gc.get_freeze_count() > before + 1000))\n"
        "assert exit_code(lambda: None) == exit_code(lambda: 0) == 0\n"
        "assert gc.get_freeze_count() == before and gc.get_threshold()[0] > 10_000\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=500, cwd=ROOT)
    assert (done.stdout, done.returncode) == ("True\n", 0), done.stderr


def test_a_crash_of_native_code_names_the_line():
    """A program that dies in a kernel or a driver leaves the Python lines of its threads on the error stream."""
    crash = (
        "import ctypes\n"
        "from arena_newton.cli.command_line import exit_code\n"
        "def work():\n    ctypes.string_at(0)\n"
        "exit_code(work)\n"
    )
    done = subprocess.run([sys.executable, "-c", crash], capture_output=True, text=True, check=False)
    assert done.returncode < 0
    assert "Fatal Python error: Segmentation fault" in done.stderr and "in work" in done.stderr


def test_a_home_that_is_nobodys_is_bad_input(capsys):
    """A path with the name of an unknown user is one line and exit code 2, in whichever command."""
    assert exit_code(lambda: int(Path("~nosuchuser/x").expanduser().exists())) == 2
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize(
    ("command", "library", "title"),
    [
        ("arena_newton.eval bench --what tick --json", "warp", None),
        ("arena_newton.trackers.evaluate --tracker twist2", "warp", "Warp, Newton and MuJoCo"),
        ("arena_newton trackers motions inspect nothing.npz", "torch", "torch"),
        ("arena_newton scenes validate football", "pxr", "USD"),
        ("arena_newton.eval certify --quick", "scipy", "SciPy"),
    ],
)
def test_a_command_says_what_it_loads_before_it_does(command, library, title, tmp_path):
    """The first line on the error stream names a large library before a line of it runs; none where JSON is asked."""
    (tmp_path / f"{library}.py").write_text("import os\nos.write(2, b'it runs\\n')\nos._exit(3)\n")
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-m", *command.split()], capture_output=True, text=True, timeout=500, env=environment
    )
    assert (done.returncode, done.stdout) == (3, "")
    assert done.stderr.splitlines() == ([] if title is None else [f"loading {title} ..."]) + ["it runs"]


@pytest.mark.parametrize("given", [{"PYTHONIOENCODING": "ascii"}, {"LC_ALL": "C", "PYTHONUTF8": "0"}])
def test_text_that_a_stream_lacks_is_no_crash(given):
    """On a stream of another character set a command without a home prints its whole answer, with `?` for the rest."""
    environment = {name: value for name, value in os.environ.items() if name != "HOME"} | given
    environment["PYTHONCOERCECLOCALE"] = "0"
    command = [sys.executable, "-m", "arena_newton", "rules"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=500, env=environment)
    assert (done.returncode, done.stderr) == (0, "") and "?" in done.stdout and len(done.stdout.splitlines()) > 50


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EACCES])
def test_a_disk_that_refuses_is_one_line(number, capsys):
    """A full or read-only disk that no part of a command foresaw is one line that names the file, and exit code 2."""

    def work():
        raise OSError(number, os.strerror(number), "/somewhere/a.json")

    assert exit_code(work) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: /somewhere/a.json: ") and said.count("\n") == 1
