"""The Unitree G1 with Dex3 hands: joint names and orders, default poses, drive gains, hand targets.

Numbers are facts of the original benchmark (its controller and asset configuration) and of Unitree's public G1 model.
Vectors over the 29 body joints are in MuJoCo order unless the name says otherwise.
"""

from dataclasses import asdict, dataclass

__all__ = [
    "ANKLES",
    "ARMS",
    "CANONICAL_JOINTS",
    "CANONICAL_TO_MUJOCO",
    "CRITICAL_BODY_WORDS",
    "DEFAULT_POSE",
    "DriveGains",
    "FEET",
    "HAND_CLOSE_LEFT",
    "HAND_CLOSE_RIGHT",
    "HAND_JOINTS",
    "HAND_OPEN",
    "LEGS",
    "MUJOCO_JOINTS",
    "MUJOCO_TO_CANONICAL",
    "PALMS",
    "PhysicsRate",
    "SONIC_DRIVE",
    "SPAWN_HEIGHT",
    "TICK",
    "TOE",
    "TWIST2_DRIVE",
    "TWIST2_HUMANOIDARENA_DRIVE",
    "WAIST",
]

TICK = 0.02
"""Control period [s] (50 Hz)."""

SPAWN_HEIGHT = 0.8
"""Pelvis height at spawn [m]."""

_LEG = ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")
_ARM = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow", "wrist_roll", "wrist_pitch", "wrist_yaw")

MUJOCO_JOINTS: tuple[str, ...] = tuple(
    [f"left_{j}_joint" for j in _LEG]
    + [f"right_{j}_joint" for j in _LEG]
    + ["waist_yaw_joint", "waist_roll_joint", "waist_pitch_joint"]
    + [f"left_{j}_joint" for j in _ARM]
    + [f"right_{j}_joint" for j in _ARM]
)
"""29 body joints in MuJoCo actuator order, which is TWIST2's order."""

LEGS: tuple[int, ...] = tuple(range(12))
"""Leg joints in MuJoCo order, left leg first."""
WAIST: tuple[int, ...] = (12, 13, 14)
"""Waist joints in MuJoCo order: yaw, roll, pitch."""
ARMS: tuple[int, ...] = tuple(range(15, len(MUJOCO_JOINTS)))
"""Arm joints in MuJoCo order, left arm first, wrists included."""

PALMS = ("left_hand_palm_link", "right_hand_palm_link")
"""Frames of the palms."""
FEET = ("left_ankle_roll_link", "right_ankle_roll_link")
"""Links of the feet, whose origins are the ankles."""
ANKLES = tuple(f"{side}_ankle_{axis}_link" for side in ("left", "right") for axis in ("pitch", "roll"))
"""All links of the ankles."""
TOE = (0.12, 0.0, -0.02)
"""Front of a foot in its link [m]: the sole ends 0.14 m ahead of it."""

CANONICAL_TO_MUJOCO: tuple[int, ...] = (
    0, 6, 12, 1, 7, 13, 2, 8, 14, 3, 9, 15, 22, 4, 10, 16, 23, 5, 11, 17, 24, 18, 25, 19, 26, 20, 27, 21, 28,
)  # fmt: skip
"""`MUJOCO_JOINTS[CANONICAL_TO_MUJOCO[i]] == CANONICAL_JOINTS[i]`."""

MUJOCO_TO_CANONICAL: tuple[int, ...] = tuple(CANONICAL_TO_MUJOCO.index(i) for i in range(len(MUJOCO_JOINTS)))
"""`CANONICAL_JOINTS[MUJOCO_TO_CANONICAL[i]] == MUJOCO_JOINTS[i]`."""

CANONICAL_JOINTS: tuple[str, ...] = tuple(MUJOCO_JOINTS[i] for i in CANONICAL_TO_MUJOCO)
"""29 body joints in the order of the canonical state and action (SONIC, Isaac Lab breadth-first)."""

_HAND = ("thumb_0", "thumb_1", "thumb_2", "middle_0", "middle_1", "index_0", "index_1")
HAND_JOINTS: tuple[str, ...] = tuple(f"{side}_hand_{f}_joint" for side in ("left", "right") for f in _HAND)
"""14 Dex3 finger joints, left hand first."""

HAND_OPEN: tuple[float, ...] = (0.0,) * 7
"""Open hand joint targets [rad]."""
HAND_CLOSE_LEFT: tuple[float, ...] = (0.0, 1.0, 1.74, -1.57, -1.74, -1.57, -1.74)
"""Closed left hand joint targets [rad]."""
HAND_CLOSE_RIGHT: tuple[float, ...] = tuple(-v for v in HAND_CLOSE_LEFT)
"""Closed right hand joint targets [rad]."""

_DEFAULT_LEG = (-0.2, 0.0, 0.0, 0.4, -0.2, 0.0)
DEFAULT_POSE: tuple[float, ...] = (
    *_DEFAULT_LEG, *_DEFAULT_LEG, 0.0, 0.0, 0.0,
    0.0, 0.4, 0.0, 1.2, 0.0, 0.0, 0.0,
    0.0, -0.4, 0.0, 1.2, 0.0, 0.0, 0.0,
)  # fmt: skip
"""Spawn pose of every task and TWIST2's default pose [rad]."""

CRITICAL_BODY_WORDS: tuple[str, ...] = ("pelvis", "torso", "waist", "hip", "thigh", "knee", "calf", "shin", "head")
"""A body whose name holds one of these (and neither `ankle` nor `foot`) counts for the fall rule's contact test."""


@dataclass(frozen=True)
class PhysicsRate:
    """Physics step and steps a control tick."""

    dt: float
    """Physics time step [s]."""
    substeps: int
    """Physics steps a 50 Hz tick."""


@dataclass(frozen=True)
class DriveGains:
    """Implicit PD drive of the 29 body joints, MuJoCo order, and of the fingers."""

    name: str
    """Name of the set in reports."""
    kp: tuple[float, ...]
    """Stiffness [N·m/rad], 29."""
    kd: tuple[float, ...]
    """Damping [N·m·s/rad], 29."""
    effort: tuple[float, ...]
    """Torque limit [N·m], 29."""
    finger_kp: float = 2.0
    """Finger stiffness [N·m/rad]; the soft drive that grasped and released in all trials."""
    finger_kd: float = 0.2
    """Finger damping [N·m·s/rad]."""
    finger_effort: float = 2.45
    """Finger torque limit [N·m]: Unitree's of thumb_0; of its other six 1.4 (docs/reference/rules.md)."""
    finger_armature: float = 0.01
    """Finger rotor inertia [kg·m²]."""
    armature: tuple[float, ...] | None = None
    """Rotor inertia of the body joints [kg·m²], 29; None: the scene's, which is that of Unitree's model."""

    def as_json(self) -> dict[str, object]:
        """Fields by name, rotor inertia only where it is declared."""
        return {key: value for key, value in asdict(self).items() if value is not None}


def _symmetric(leg: tuple, waist: tuple, arm: tuple) -> tuple[float, ...]:
    return tuple(float(v) for v in (*leg, *leg, *waist, *arm, *arm))


TWIST2_DRIVE = DriveGains(
    name="twist2",
    kp=_symmetric((100, 100, 100, 150, 40, 40), (150, 150, 150), (40, 40, 40, 40, 20, 20, 20)),
    kd=_symmetric((2, 2, 2, 4, 2, 2), (4, 4, 4), (5, 5, 5, 5, 1, 1, 1)),
    effort=_symmetric((88, 139, 88, 139, 50, 50), (88, 50, 50), (25, 25, 25, 25, 25, 5, 5)),
)
"""TWIST2's own gains with the real robot's wrists (20/1), limited by Unitree's joint torque ranges."""

TWIST2_HUMANOIDARENA_DRIVE = DriveGains(
    name="twist2-humanoidarena",
    kp=_symmetric((130, 100, 100, 160, 60, 40), (150, 150, 150), (40, 40, 40, 40, 20, 20, 20)),
    kd=_symmetric((3, 3, 2, 4.5, 6.5, 2), (4, 4.5, 8), (5, 5, 5, 5, 1, 1, 1)),
    effort=_symmetric((100, 110, 100, 150, 40, 40), (150, 150, 150), (60, 60, 60, 60, 60, 60, 60)),
)
"""The original benchmark's retuned TWIST2 gains (its robot asset)."""

SONIC_DRIVE = DriveGains(
    name="sonic",
    kp=_symmetric(
        (99.02755, 99.02755, 40.168964, 99.02755, 48.445627, 28.445627),
        (40.168964, 28.445627, 28.445627),
        (14.222814, 34.222814, 24.222814, 19.222814, 14.222814, 16.77876, 16.77876),
    ),
    kd=_symmetric(
        (3.1559467, 3.1559467, 1.2792531, 3.1559467, 0.90733415, 0.90733415),
        (1.2792531, 0.90733415, 0.90733415),
        (0.45366707, 0.45366707, 0.45366707, 0.45366707, 0.45366707, 0.53407073, 0.53407073),
    ),
    effort=TWIST2_HUMANOIDARENA_DRIVE.effort,
)
"""SONIC's gains as the original benchmark drives it (some raised); the asset's effort limits stay in force."""
