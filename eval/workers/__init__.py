"""Episodes played by other processes: batches of a plan, clusters, and shards that are merged."""
