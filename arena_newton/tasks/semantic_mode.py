"""Semantic mode in words: what it changes in which of the paper's tasks, and who chose how strong these changes are."""

from arena_newton import tasks

__all__ = ["semantic_note", "task_title"]

CHANGES = {
    "texture": "textures and colours in",
    "shape": "the shape of a target that is drawn without a collider in",
    "clutter": "things that are added in",
}
"""Change that semantic mode makes → words for it."""


def task_title(task: str) -> str:
    """A task as the paper's tables name it, such as `DoubleDesk`."""
    return {"pp_box": "P&PBox"}.get(task, "".join(word.capitalize() for word in task.split("_")))


def semantic_note() -> str:
    """Sentences next to every table of numbers of semantic mode."""
    parts = []
    for change, words in CHANGES.items():
        named = [task_title(name) for name in tasks.PAPER if tasks.get(name).semantic_change == change]
        parts += [f"{words} {', '.join(named)}"] if named else []
    return (
        f"Semantic mode changes looks, and nothing that moves or collides in base mode: {'; '.join(parts)}. (Under "
        "rules released what counts in VisNavi becomes a disc, too, and Football has a second ball.) How strong these "
        "shifts are was chosen here (bricks, wood, a blue sofa; the original's files were not at hand): how much a "
        "policy loses cannot be compared with the paper, only the direction."
    )
