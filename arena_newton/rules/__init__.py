"""Value types of a rule set, and the seeds of an episode."""
