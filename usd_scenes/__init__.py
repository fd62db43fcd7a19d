"""USD scenes: the authors that write the `.usda` layers, their validator, and the layers themselves."""
