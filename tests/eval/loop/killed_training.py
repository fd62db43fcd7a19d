"""`policies.train` in a process that kills itself after two steps."""

import os
import signal

from arena_newton.policies.train.__main__ import main as command_line
from arena_newton.policies.train.policy_trainer import PolicyTrainer


def main(arguments):
    """Train until it is killed."""
    advance = PolicyTrainer.advance

    def kill(self):
        if self.step == 2:
            os.kill(os.getpid(), signal.SIGKILL)
        return advance(self)

    PolicyTrainer.advance = kill
    return command_line(arguments)
