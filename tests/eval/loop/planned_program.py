"""A command of a plan that imports nothing: it says what it finds, and succeeds, fails, or waits to be told to end."""

import os
import signal
import sys
import time
from pathlib import Path

if __name__ == "__main__":
    what, mark = sys.argv[1], Path(sys.argv[2])
    if what == "fail" and not mark.exists():
        mark.touch()
        sys.exit("a reason of its own")
    if what == "refuse":
        mark.open("a").write("x")
        sys.exit(2)
    if what == "wait":
        signal.signal(signal.SIGTERM, lambda *_: (Path(f"{mark}.told").touch(), os._exit(3)))
        mark.write_text(str(os.getpid()))
        time.sleep(600)
    with mark.open("a") as file:
        file.write(f"{os.environ['CUDA_VISIBLE_DEVICES']}\n")
