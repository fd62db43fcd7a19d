"""Boxing: reach the green target at one of two bags."""
