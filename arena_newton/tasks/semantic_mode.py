"""Semantic modes in words: changes in which of the paper's tasks, and who chose how strong they are."""

from collections.abc import Iterable

from arena_newton import tasks
from arena_newton.rules import modes

__all__ = ["semantic_note", "semantic_notes", "task_title"]

CHANGES = {
    "texture": "textures and colours in",
    "shape": "the shape of a target without a collider in",
    "clutter": "added objects in",
}
"""Change that semantic mode makes → words for it."""


def task_title(task: str) -> str:
    """A task as the paper's tables name it, such as `DoubleDesk`."""
    return {"pp_box": "P&PBox"}.get(task, "".join(word.capitalize() for word in task.split("_")))


def semantic_notes(named: Iterable[str]) -> list[str]:
    """Notes next to every table of numbers of these modes; none where no mode is a semantic one."""
    played = set(named)
    found = [semantic_note()] if "semantic" in played else []
    if held := " and ".join(mode for mode in modes.HELD_OUT if mode in played):
        found.append(
            f"{held}: held-out looks of this project, none of the paper's: other colours, textures, drawn shapes and "
            "decor than semantic mode, and other clutter in P&PBox; nothing else that moves or collides differs from "
            "base mode. They count as unseen for policies that were neither trained nor tuned on them."
        )
    others = [modes.get(name) for name in modes.names() if name in played]
    return found + [f"{mode.name}: none of the paper's modes: {mode.sentence}." for mode in others if not mode.ruled]


def semantic_note() -> str:
    """Sentences next to every table of numbers of semantic mode."""
    parts = []
    for change, words in CHANGES.items():
        named = [task_title(name) for name in tasks.PAPER if tasks.get(name).semantic_change == change]
        parts += [f"{words} {', '.join(named)}"] if named else []
    return (
        f"Semantic mode changes looks, and nothing that moves or collides in base mode: {'; '.join(parts)}. (Under "
        "rules released the goal zone of VisNavi becomes a disc as well, and Football has a second ball.) The "
        "strength of these shifts was chosen here (bricks, wood, a blue sofa), because the original's files were not "
        "available: the direction of a loss can be compared with the paper, its size cannot."
    )
