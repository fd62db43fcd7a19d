"""OpenDoor: press the lever, push the leaf, walk through."""
