"""Statistics of success rates: numbers in, numbers out."""
