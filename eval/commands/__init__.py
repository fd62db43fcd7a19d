"""Commands of evaluation with their options."""
