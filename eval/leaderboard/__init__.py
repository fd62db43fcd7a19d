"""Leaderboard: results that others hand in, checked, and published as one site of static pages."""
