"""The command line with the stand-ins of `eval_fakes` on a machine that says it has GPUs, importable by its name.

Which GPUs a process sees is written to the file `FAKE_GPUS` names when it builds a world.
"""

import os
import sys

import eval_fakes
import torch
import warp

from arena_newton.physics import devices

devices.DRIVERS = ("libc.so.6",)  # a library that loads
warp.is_cuda_available = lambda: True
warp.get_cuda_devices = lambda: [type("Device", (), {"alias": "cuda:0"})]
torch.cuda.get_device_name = lambda device: "a GPU"


class SeeingEnv(eval_fakes.FakeEnv):
    """A world that says which GPUs its process sees."""

    def __init__(self, task, **options):
        super().__init__(task, **options)
        assert options["device"] == "cuda:0"
        with open(os.environ["FAKE_GPUS"], "a") as file:
            file.write(f"{os.getpid()} {os.environ.get('CUDA_VISIBLE_DEVICES')}\n")


if __name__ == "__main__":
    import fakes_with_gpus

    from arena_newton.eval.__main__ import main

    sys.exit(main(sys.argv[1:], eval_fakes.factories(env=fakes_with_gpus.SeeingEnv)))
