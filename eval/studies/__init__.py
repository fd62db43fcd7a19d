"""Studies that choose placements or compare actions: sensitivity, adversary, t-SNE, engines."""
