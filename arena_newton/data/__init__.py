"""Episodes as files: what a demonstration holds, how one is recorded and read, and datasets made of them."""
