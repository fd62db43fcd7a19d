"""Arithmetic of the benchmark as Warp functions, kernels and one launch wrapper each; imports Warp alone."""

import warp as wp

# Hundreds of module loads would drown a progress bar; `wp.config.log_level = wp.LOG_INFO` brings them back.
if wp.config.log_level == wp.LOG_INFO:
    wp.config.log_level = wp.LOG_WARNING
