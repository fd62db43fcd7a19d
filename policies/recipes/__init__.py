"""How policies are trained: the paper's settings and faster ones, a file each."""
