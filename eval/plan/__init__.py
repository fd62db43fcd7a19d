"""Plan of an evaluation: which episodes are due, and options resolved once. Nothing is built, nothing runs."""
