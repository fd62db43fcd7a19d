"""Measures of speed, of this product and beside other programs."""
