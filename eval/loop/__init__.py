"""Learning loop: record, build, train, evaluate, report."""
