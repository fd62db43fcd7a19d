"""Training recipes of policies: the paper's settings and faster ones, a file each."""
