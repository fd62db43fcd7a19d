"""Settings of the bench that replays with other instructions are ones that the libraries take."""

import numpy as np
import pytest
import warp as wp

from benchmarks.audits.processors import SETTINGS, WARP


@pytest.mark.parametrize("flags", sorted({setting[WARP] for setting in SETTINGS.values() if WARP in setting}))
def test_warp_compiles_for_each_processor(flags):
    """Warp's compiler takes the flags of every setting that has some."""

    @wp.kernel(module="unique", module_options={"cpu_compiler_flags": flags})
    def doubled(values: wp.array[wp.float32]):
        values[wp.tid()] = 2.0 * values[wp.tid()]

    values = wp.ones(3, dtype=wp.float32, device="cpu")
    wp.launch(doubled, dim=3, inputs=[values], device="cpu")
    np.testing.assert_array_equal(values.numpy(), 2.0)
