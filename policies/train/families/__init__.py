"""Families of policies as the trainer needs them: losses, processors, saving."""
