"""Episodes played in this process: environments, recorders and the flow of a run."""
