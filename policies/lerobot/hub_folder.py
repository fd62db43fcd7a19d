"""A checkpoint that is named on the Hugging Face hub, in the hub's own cache."""

from __future__ import annotations

from pathlib import Path

import huggingface_hub

from arena_newton.errors import InputError

__all__ = ["fetched"]

FILES = ("*.json", "*.safetensors")
"""Files that are fetched: no pickles, no code."""
PATIENCE = 5.0
"""Longest wait for the hub's first answer [s]."""


def fetched(name: str) -> Path:
    """Folder of a checkpoint, fetched unless it is in the cache already.

    Args:
        name: `owner/name`.

    Raises:
        InputError: It is not in the cache and cannot be fetched: no network, no such name, or no right to it.
    """
    for cached in (True, False):
        try:
            if not cached:  # fetching itself waits for as long as a hub that does not answer keeps the connection
                huggingface_hub.HfApi().model_info(name, timeout=PATIENCE)
            found = huggingface_hub.snapshot_download(
                name, allow_patterns=list(FILES), local_files_only=cached, etag_timeout=PATIENCE
            )
            return Path(found)
        except Exception as error:  # of the hub, of its network library, of the file system
            reason = " ".join(str(error).split())[:200]
    raise InputError(
        f"--policy lerobot:{name}: is no folder here, and the Hugging Face hub does not give a checkpoint of that name "
        f"({reason})"
    )
