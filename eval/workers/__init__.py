"""Episodes played by other processes: slices of a plan, clusters, and shards that are merged."""
