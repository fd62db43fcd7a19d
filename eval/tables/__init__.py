"""Tables, findings and comparisons of many runs, beside the numbers that the paper prints."""
