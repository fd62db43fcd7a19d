"""USD scenes: the `.usda` layers and their validator."""
