"""Statements of docs/howto/bring/asking_servers.md hold: protocols, ports, keys and limits."""

import re
from pathlib import Path

from arena_newton.policies.protocols import openpi_codec
from arena_newton.policies.protocols.handshake import RATE, ServedFacts, expected_facts
from arena_newton.policies.remote.address import PREFIXES, TOKEN_VARIABLE
from arena_newton.policies.remote.client import MAX_FAILURES, MAX_REPLY
from arena_newton.policies.remote.gr00t_client import Gr00tPolicy
from arena_newton.policies.remote.openpi_client import ROBOARENA_IMAGE_KEY, OpenpiPolicy
from arena_newton.policies.remote.vla_eval_client import VlaEvalPolicy
from arena_newton.robot.canonical import ACTION, STATE

ROOT = Path(__file__).parents[3]
TEXT = (ROOT / "docs" / "howto" / "bring" / "asking_servers.md").read_text()
PLAIN = " ".join(TEXT.split())


def rows(title):
    """Cells of the table whose first header cell is `title`."""
    lines = TEXT[TEXT.index(f"| {title} |") :].split("\n\n")[0].splitlines()[2:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_protocols_and_ports():
    """Every protocol is in the table, with its usual port and the extra that it needs."""
    named = {}
    for addresses, _, ports, _ in rows("`--policy remote:`"):
        found = re.findall(r"`([\w+-]+)://", addresses)
        named |= dict(zip(found, ports.split(", "), strict=True))
    assert set(named) <= set(PREFIXES) and {prefix for prefix in PREFIXES if "+" not in prefix} <= set(named)
    assert all(int(port) == PREFIXES[prefix][2] for prefix, port in named.items())


def test_keys_and_limits():
    """Keys, names of slices and numbers are those of the code."""
    keys = (openpi_codec.IMAGE_KEY, openpi_codec.STATE_KEY, openpi_codec.PROMPT_KEY, ROBOARENA_IMAGE_KEY)
    assert all(f"`{key}`" in TEXT for key in keys)
    assert ", ".join(f"`{name}`" for name in STATE) in PLAIN and ", ".join(f"`{name}`" for name in ACTION) in PLAIN
    assert f"at most {MAX_REPLY >> 20} MiB" in PLAIN and f"{MAX_FAILURES} requests in a row" in PLAIN
    assert f"must be {RATE:g}" in PLAIN and TOKEN_VARIABLE in PLAIN
    sizes = [(c.camera.width, c.camera.height, c.camera.fit) for c in (OpenpiPolicy, VlaEvalPolicy, Gr00tPolicy)]
    assert sizes == [(224, 224, "pad"), (224, 224, "pad"), (640, 480, "native")]
    assert "224×224 with black bars (openpi, vla-eval)" in PLAIN and "640×480 for GR00T" in PLAIN


def test_declarations():
    """The table has every key of a declaration that is compared or followed."""
    said = set(re.findall(r"`(\w+)`", " ".join(row[0] for row in rows("declared"))))
    known = set(ServedFacts(**{name: () for name in ("action_names", "state_names")}).to_json())
    known |= {"labels", "realign", "picture", "needs_picture", "cameras", "chunk_length", "rate_hz"}
    known |= {"action_names", "state_names"}
    assert said == known - {"arena", "batched"} and expected_facts().rate_hz == RATE
