"""Pretrained weights by name on the hub or in a local folder: found at once, or refused with one clear error."""

from __future__ import annotations

import hashlib
import re
import urllib.error
import urllib.request
from collections.abc import Iterable, Sequence
from pathlib import Path

import torch
from huggingface_hub import constants, snapshot_download
from huggingface_hub.errors import HfHubHTTPError, LocalEntryNotFoundError
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file

from arena_newton.errors import InputError

__all__ = ["PATIENCE", "check_safetensors", "checksum", "read_safetensors", "weights_folder"]

PATIENCE = 10.0
"""Longest wait for the hub [s]."""
_HUB_NAME = re.compile(r"[\w.-]+/[\w.-]+")


def weights_folder(wanted: str | Path, what: str, patterns: Sequence[str]) -> Path:
    """The local folder of pretrained weights; downloaded where it is a name on the hub that is not in its cache.

    Args:
        wanted: Folder, or name on the hub such as `openai/clip-vit-base-patch16`.
        what: What the weights are, for messages.
        patterns: Files that are needed, as names with `*`.

    Raises:
        InputError: There is no such folder, or the hub does not answer within `PATIENCE`, or has no such name.
    """
    folder = Path(wanted).expanduser()
    if folder.is_dir():
        return folder
    name = str(wanted)
    if not _HUB_NAME.fullmatch(name) or name.startswith("."):
        raise InputError(f"--weights {name}: no such folder, looked for {what} there")
    try:
        return Path(snapshot_download(name, allow_patterns=list(patterns), local_files_only=True))
    except LocalEntryNotFoundError:
        pass
    advice = f"{what} {name}: neither a folder nor in the cache {constants.HF_HUB_CACHE}, and"
    local = "--weights FOLDER takes a local copy"
    if constants.is_offline_mode():
        raise InputError(f"{advice} HF_HUB_OFFLINE forbids to download it; {local}")
    address = f"{constants.ENDPOINT}/api/models/{name}"
    try:
        urllib.request.urlopen(address, timeout=PATIENCE).close()
        return Path(snapshot_download(name, allow_patterns=list(patterns), etag_timeout=PATIENCE))
    except (OSError, ValueError, HfHubHTTPError) as error:
        raise InputError(f"{advice} {address} does not give it ({error}); {local}") from None


def read_safetensors(path: Path) -> dict[str, torch.Tensor]:
    """Tensors of a file, on the CPU.

    Raises:
        InputError: The file is not there, or damaged.
    """
    try:
        return load_file(path)
    except (OSError, SafetensorError, ValueError) as error:
        raise InputError(f"{path}: not readable as safetensors ({error})") from None


def check_safetensors(path: Path) -> None:
    """Make sure that a file of tensors is there and as long as its header says; none is read.

    Raises:
        InputError: It is not.
    """
    try:
        with safe_open(path, framework="pt"):
            pass
    except (OSError, SafetensorError, ValueError) as error:
        raise InputError(f"{path}: not readable as safetensors ({error})") from None


def checksum(tensors: Iterable[tuple[str, torch.Tensor]]) -> str:
    """SHA-256 of names, shapes and values as float32, in the order of the names."""
    digest = hashlib.sha256()
    for name, tensor in sorted(tensors, key=lambda pair: pair[0]):
        digest.update(f"{name} {list(tensor.shape)}\n".encode())
        digest.update(tensor.detach().cpu().float().contiguous().numpy().data)
    return digest.hexdigest()
