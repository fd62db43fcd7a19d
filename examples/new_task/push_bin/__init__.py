"""PushBin, a task of another package than arena_newton: its record, its scene with its builder, and its expert."""
