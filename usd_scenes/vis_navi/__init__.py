"""VisNavi: walk round the obstacles into the marked square."""
