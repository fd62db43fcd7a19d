"""Handshake: facts that a policy server declares, compared with the robot's requirements before the first episode.

The record is JSON: openpi's metadata frame holds it, vla-eval's HELLO under `arena`, and `GET /config` answers it in
every protocol. What a server does not declare is None here: nobody can compare it, and the robot says so.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Annotated, Literal

from arena_newton.data.readers.label_protocols import LABELS, action_names
from arena_newton.data.recording.layouts import state_names
from arena_newton.errors import InputError
from arena_newton.files.stored_json import Fit, Known, loaded
from arena_newton.files.text import plain_text
from arena_newton.pictures.settings import CAMERAS, CameraConfig
from arena_newton.policies.protocols.policy_messages import LONGEST_CHUNK, PICTURE_SIDES
from arena_newton.policies.protocols.wire_error import WireError
from arena_newton.robot import g1

__all__ = ["HANDSHAKE_VERSION", "RATE", "ServedFacts", "ServedPicture", "compare_facts", "expected_facts", "read_facts"]

HANDSHAKE_VERSION = 1
"""Version of the record, its key `arena`."""
RATE = round(1.0 / g1.TICK, 6)
"""Actions per second [Hz]."""
MOST_NAMES = 4096
"""Most names of a list."""


def _is_json(value: object) -> bool:
    """True if results can hold a value; MessagePack knows more than JSON."""
    try:
        json.dumps(value, allow_nan=False)
    except (TypeError, ValueError, RecursionError):
        return False
    return True


Side = Annotated[int, Fit("pixels", lambda value: PICTURE_SIDES[0] <= value <= PICTURE_SIDES[1])]
Names = Annotated[tuple[str, ...], Fit("a list of names", lambda value: len(value) <= MOST_NAMES)]
Length = Annotated[int, Fit("a number of actions", lambda value: 0 <= value <= LONGEST_CHUNK)]
Labels = Annotated[str, Known(lambda: LABELS)]
Facts = Annotated[Mapping[str, object], Fit("a JSON object", _is_json)]


@dataclass(frozen=True)
class ServedPicture:
    """The picture that a policy wants."""

    width: Side
    """[px]"""
    height: Side
    """[px]"""
    fit: Literal["pad", "native"] = "pad"
    """`pad` or `native`, as in `CameraConfig`."""

    @classmethod
    def of(cls, camera: CameraConfig) -> ServedPicture:
        """The picture of a camera."""
        return cls(camera.width, camera.height, camera.fit)

    @property
    def camera(self) -> CameraConfig:
        """A camera whose picture it is."""
        return CameraConfig(width=self.width, height=self.height, fit=self.fit)


Cameras = Annotated[
    Mapping[Annotated[str, Known(lambda: CAMERAS)], ServedPicture],
    Fit(f"width, height and fit of pictures of {', '.join(CAMERAS)} or some of these", lambda cameras: bool(cameras)),
]


@dataclass(frozen=True)
class ServedFacts:
    """Facts that a server declares; None: not declared."""

    policy: str = ""
    """Identity in results: the policy's name and a hash of its description."""
    labels: Labels | None = None
    """Protocol of its actions (`data.readers.label_protocols`)."""
    realign: Annotated[float, Fit("0 to 1", lambda value: 0 <= value <= 1)] | None = None
    """Fraction of the gap between the commanded and the measured heading that whoever decodes actions of v4 closes each
    tick; of v4 only."""
    action_names: Names | None = None
    """Names of the numbers of an action, in their order."""
    state_names: Names | None = None
    """Names of the numbers of a state, in their order."""
    chunk_length: Length | None = None
    """Actions per chunk; 0: they differ."""
    rate_hz: Annotated[float, Fit("a rate", lambda value: 0 < value < 1e6)] | None = None
    """Actions per second [Hz]."""
    needs_picture: bool | None = None
    """True if the policy observes pictures."""
    picture: ServedPicture | None = None
    """The head camera's picture that it looks at; pictures of other sizes are resized by the server."""
    cameras: Cameras | None = None
    """The picture of each camera, where they are not the head camera's alone."""
    batched: bool = False
    """True if one request may hold several robots, along a leading axis."""
    seeded: bool = False
    """True if an episode follows from its seed and its observations, whoever else asks."""
    facts: Facts = field(default_factory=dict)
    """The policy's own description, `Policy.describe`."""

    def to_json(self) -> dict[str, object]:
        """The record as JSON; what is not declared is left out."""
        content: dict[str, object] = {
            "arena": HANDSHAKE_VERSION,
            "policy": self.policy,
            "labels": self.labels,
            "realign": self.realign,
            "action_names": self.action_names and list(self.action_names),
            "state_names": self.state_names and list(self.state_names),
            "chunk_length": self.chunk_length,
            "rate_hz": self.rate_hz,
            "needs_picture": self.needs_picture,
            "picture": self.picture and asdict(self.picture),
            "cameras": self.cameras and {name: asdict(one) for name, one in self.cameras.items()},
            "batched": self.batched,
            "seeded": self.seeded,
            "facts": dict(self.facts),
        }
        return {key: value for key, value in content.items() if value is not None}

    def undeclared(self) -> list[str]:
        """Names of what the server does not declare, as a message lists them."""
        facts = {
            "label protocol": self.labels,
            "action names": self.action_names,
            "state names": self.state_names,
            "chunk length": self.chunk_length,
            "rate": self.rate_hz,
            "picture": self.needs_picture if self.needs_picture is not True else self.cameras or self.picture,
        }
        return [name for name, value in facts.items() if value is None]


def expected_facts(labels: str = "v3.1") -> ServedFacts:
    """Requirements of this robot, with actions of a label protocol."""
    return ServedFacts(
        labels=labels, action_names=tuple(action_names(labels)), state_names=tuple(state_names()), rate_hz=RATE
    )


def read_facts(content: object, where: str) -> ServedFacts:
    """The record of a server from its JSON; a server that knows nothing of it declares nothing.

    Args:
        content: What the server sent.
        where: What errors name as the origin.

    Raises:
        WireError: The record is damaged or of a later version.
    """
    if not isinstance(content, Mapping):
        raise WireError(f"{where}: its metadata is {type(content).__name__}, expected a map")
    if "arena" not in content:
        return ServedFacts()
    if content["arena"] != HANDSHAKE_VERSION or isinstance(content["arena"], bool):
        version = plain_text(content["arena"], 40)
        raise WireError(f"{where}: its handshake has version {version}, expected {HANDSHAKE_VERSION}")
    declared = {key: value for key, value in content.items() if value is not None}
    if "picture" in declared:
        declared["picture"] = _known(declared["picture"])
    if isinstance(cameras := declared.get("cameras"), Mapping):
        declared["cameras"] = {name: _known(one) for name, one in cameras.items()}
    try:
        facts = loaded(f"{where}: it declares", declared, ServedFacts)
    except InputError as error:
        raise WireError(str(error)) from None
    realign, rate = (None if number is None else float(number) for number in (facts.realign, facts.rate_hz))
    return replace(facts, policy=plain_text(facts.policy, 200), realign=realign, rate_hz=rate)


def _known(picture: object) -> object:
    """A picture's entries that we know: of later versions it may say more."""
    if not isinstance(picture, Mapping):
        return picture
    return {key: value for key, value in picture.items() if key in ServedPicture.__dataclass_fields__}


def compare_facts(declared: ServedFacts, wanted: ServedFacts, where: str) -> None:
    """Refuse a server whose actions or states are others; what one of both does not declare is not compared.

    Args:
        declared: Of the server.
        wanted: Of the robot, `expected_facts`.
        where: What the message names as the origin.

    Raises:
        InputError: They differ; the message names both values.
    """
    if None not in (declared.labels, wanted.labels) and declared.labels != wanted.labels:
        raise InputError(
            f"{where}: the server gives actions of label protocol {declared.labels}, the robot takes {wanted.labels}"
        )
    _compare_names(declared.action_names, wanted.action_names, where, "action")
    _compare_names(declared.state_names, wanted.state_names, where, "state")
    rates = (declared.rate_hz, wanted.rate_hz)
    if rates[0] is not None and rates[1] is not None and abs(rates[0] - rates[1]) > 1e-3:
        raise InputError(f"{where}: the server's actions are for {rates[0]:g} Hz, the robot executes {rates[1]:g} Hz")
    lengths = (declared.chunk_length, wanted.chunk_length)
    if lengths[0] and lengths[1] and lengths[0] != lengths[1]:
        raise InputError(f"{where}: the server's chunks have {lengths[0]} actions, the robot expects {lengths[1]}")
    if None not in (declared.picture, wanted.picture) and declared.picture != wanted.picture:
        raise InputError(
            f"{where}: the server wants {_shown(declared.picture)}, the robot sends {_shown(wanted.picture)}"
        )


def _shown(picture: ServedPicture | None) -> str:
    return "no picture" if picture is None else f"pictures of {picture.width}x{picture.height}, {picture.fit}"


def _compare_names(declared: Sequence[str] | None, wanted: Sequence[str] | None, where: str, noun: str) -> None:
    if declared is None or wanted is None:
        return
    if len(declared) != len(wanted):
        raise InputError(f"{where}: the server's {noun} has {len(declared)} numbers, the robot's {len(wanted)}")
    for index, (theirs, ours) in enumerate(zip(declared, wanted, strict=True)):
        if theirs != ours:
            raise InputError(
                f"{where}: number {index} of the server's {noun} is {plain_text(theirs, 80)}, of the robot's {ours}"
            )
