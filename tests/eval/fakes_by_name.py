"""The command line with the stand-ins of `eval_fakes` as a module, which other processes can import by its name."""

import sys

from eval_fakes import factories

from arena_newton.eval.__main__ import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:], factories()))
