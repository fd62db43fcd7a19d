"""Seconds of a test run, by file and by test, from what `pytest --durations=0` printed.

`uv run pytest --durations=0 | tee tests.log; python tests/durations.py tests.log`
"""

import re
import sys
from collections import Counter
from pathlib import Path

LINE = re.compile(r"([\d.]+)s (call|setup|teardown) +(tests/(\S+?\.py)::.+)")
"""Seconds, phase, test and file of a line."""


def main(log: str, files: int = 25, tests: int = 25) -> None:
    """Prints the total, the files and the tests that take the longest, as Markdown."""
    by_file: Counter[str] = Counter()
    by_test: list[tuple[float, str, str]] = []
    for seconds, phase, test, file in LINE.findall(Path(log).read_text(errors="replace")):
        by_file[file] += float(seconds)
        by_test.append((float(seconds), phase, test))
    print(f"{sum(by_file.values()):.0f} s of calls and fixtures, in all processes together.\n\n| s | file |\n|--:|---|")
    for file, seconds in by_file.most_common(files):
        print(f"| {seconds:.0f} | {file} |")
    print("\n| s | | test |\n|--:|---|---|")
    for seconds, phase, test in sorted(by_test, reverse=True)[:tests]:
        print(f"| {seconds:.1f} | {phase} | {test.removeprefix('tests/')} |")


if __name__ == "__main__":
    main(*sys.argv[1:2])
