"""Physics: a USD scene becomes one Newton model that the engines `mujoco` and `warp` step."""
