"""Link and joint numbers of the Unitree G1 (29 body joints) with Dex3 hands (2 x 7 joints).

Source: Unitree's public G1 model as TWIST2 publishes it for MuJoCo (`g1_sim2sim_29dof_with_hands.xml`): offsets, masses,
inertias, joint axes, ranges and torque limits. Body joint armatures come from the sister file without hands
(`g1_sim2sim_29dof.xml`; zero for the waist pitch and the wrists there), since the file with hands gives them to one leg's
hip alone. Finger armature 0.01 is the value with which the soft finger drive grasped in trials. The pelvis row includes
the jointless `pelvis_contour_link` (1 g). Rows stand depth first, parents before children, left before right.
"""

from dataclasses import dataclass

__all__ = ["Hinge", "LINKS", "Link", "PALM_OFFSET"]

IDENTITY = (1.0, 0.0, 0.0, 0.0)
PALM_OFFSET = 0.0415, 0.003
"""Palm frame on the wrist_yaw link: x, and y mirrored between the hands [m]; that of the palm mesh in the MJCF."""


@dataclass(frozen=True)
class Hinge:
    """The revolute joint that carries a link."""

    name: str
    """Joint name."""
    axis: str
    """Axis `X`, `Y` or `Z` of the link's own frame; the joint sits at the link's origin."""
    limits: tuple[float, float]
    """Lower and upper angle [rad]."""
    armature: float
    """Rotor inertia seen at the joint [kg·m²]."""
    effort: float
    """Torque limit of the motor [N·m]."""


@dataclass(frozen=True)
class Link:
    """A rigid link."""

    name: str
    """Link name."""
    parent: str | None
    """Parent link, or None for the floating base."""
    offset: tuple[float, float, float]
    """Origin in the parent's frame at joint angle zero [m]."""
    quat: tuple[float, float, float, float]
    """Orientation in the parent's frame at joint angle zero, wxyz."""
    mass: float
    """Mass [kg]."""
    com: tuple[float, float, float]
    """Centre of mass in the link's frame [m]."""
    inertia: tuple[float, float, float]
    """Principal moments of inertia about the centre of mass [kg·m²]."""
    principal: tuple[float, float, float, float]
    """Orientation of the principal axes in the link's frame, wxyz."""
    hinge: Hinge | None
    """The joint to the parent."""


# fmt: off
# ruff: noqa: E501
LINKS: tuple[Link, ...] = (
    Link("pelvis", None, (0, 0, 0), IDENTITY,
         3.814, (0, 0, -0.0760300603), (0.0105548821, 0.00931478209, 0.0079185), (0.999999921, 0, -0.000398272561, 0),
         None),
    Link("left_hip_pitch_link", "pelvis", (0, 0.064452, -0.1027), IDENTITY,
         1.35, (0.002741, 0.047791, -0.02606), (0.00181517, 0.00153422, 0.00116212), (0.954862, 0.293964, 0.0302556, 0.030122),
         Hinge("left_hip_pitch_joint", "Y", (-2.5307, 2.8798), 0.0103, 88.0)),
    Link("left_hip_roll_link", "left_hip_pitch_link", (0, 0.052, -0.030465), (0.996179, 0, -0.0873386, 0),
         1.52, (0.029812, -0.001045, -0.087934), (0.00254986, 0.00241169, 0.00148755), (0.977808, -1.97119e-05, 0.205576, -0.0403793),
         Hinge("left_hip_roll_joint", "X", (-0.5236, 2.9671), 0.0251, 139.0)),
    Link("left_hip_yaw_link", "left_hip_roll_link", (0.025001, 0, -0.12412), IDENTITY,
         1.702, (-0.057709, -0.010981, -0.15078), (0.00776166, 0.00717575, 0.00160139), (0.600598, 0.15832, 0.223482, 0.751181),
         Hinge("left_hip_yaw_joint", "Z", (-2.7576, 2.7576), 0.0103, 88.0)),
    Link("left_knee_link", "left_hip_yaw_link", (-0.078273, 0.0021489, -0.17734), (0.996179, 0, 0.0873386, 0),
         1.932, (0.005457, 0.003964, -0.12074), (0.0113804, 0.0112778, 0.00146458), (0.923418, -0.0327699, 0.0158246, 0.382067),
         Hinge("left_knee_joint", "Y", (-0.087267, 2.8798), 0.0251, 139.0)),
    Link("left_ankle_pitch_link", "left_knee_link", (0, -9.4445e-05, -0.30001), IDENTITY,
         0.074, (-0.007269, 0, 0.011137), (1.89e-05, 1.40805e-05, 6.9195e-06), (0.603053, 0.369225, 0.369225, 0.603053),
         Hinge("left_ankle_pitch_joint", "Y", (-0.87267, 0.5236), 0.003597, 50.0)),
    Link("left_ankle_roll_link", "left_ankle_pitch_link", (0, 0, -0.017558), IDENTITY,
         0.608, (0.026505, 0, -0.016425), (0.00167218, 0.0016161, 0.000217621), (-0.000481092, 0.728482, -0.000618967, 0.685065),
         Hinge("left_ankle_roll_joint", "X", (-0.2618, 0.2618), 0.003597, 50.0)),
    Link("right_hip_pitch_link", "pelvis", (0, -0.064452, -0.1027), IDENTITY,
         1.35, (0.002741, -0.047791, -0.02606), (0.00181517, 0.00153422, 0.00116212), (0.954862, -0.293964, 0.0302556, -0.030122),
         Hinge("right_hip_pitch_joint", "Y", (-2.5307, 2.8798), 0.0103, 88.0)),
    Link("right_hip_roll_link", "right_hip_pitch_link", (0, -0.052, -0.030465), (0.996179, 0, -0.0873386, 0),
         1.52, (0.029812, 0.001045, -0.087934), (0.00254986, 0.00241169, 0.00148755), (0.977808, 1.97119e-05, 0.205576, 0.0403793),
         Hinge("right_hip_roll_joint", "X", (-2.9671, 0.5236), 0.0251, 139.0)),
    Link("right_hip_yaw_link", "right_hip_roll_link", (0.025001, 0, -0.12412), IDENTITY,
         1.702, (-0.057709, 0.010981, -0.15078), (0.00776166, 0.00717575, 0.00160139), (0.751181, 0.223482, 0.15832, 0.600598),
         Hinge("right_hip_yaw_joint", "Z", (-2.7576, 2.7576), 0.0103, 88.0)),
    Link("right_knee_link", "right_hip_yaw_link", (-0.078273, -0.0021489, -0.17734), (0.996179, 0, 0.0873386, 0),
         1.932, (0.005457, -0.003964, -0.12074), (0.011374, 0.0112843, 0.00146452), (0.923439, 0.0345276, 0.0116333, -0.382012),
         Hinge("right_knee_joint", "Y", (-0.087267, 2.8798), 0.0251, 139.0)),
    Link("right_ankle_pitch_link", "right_knee_link", (0, 9.4445e-05, -0.30001), IDENTITY,
         0.074, (-0.007269, 0, 0.011137), (1.89e-05, 1.40805e-05, 6.9195e-06), (0.603053, 0.369225, 0.369225, 0.603053),
         Hinge("right_ankle_pitch_joint", "Y", (-0.87267, 0.5236), 0.003597, 50.0)),
    Link("right_ankle_roll_link", "right_ankle_pitch_link", (0, 0, -0.017558), IDENTITY,
         0.608, (0.026505, 0, -0.016425), (0.00167218, 0.0016161, 0.000217621), (0.000481092, 0.728482, 0.000618967, 0.685065),
         Hinge("right_ankle_roll_joint", "X", (-0.2618, 0.2618), 0.003597, 50.0)),
    Link("waist_yaw_link", "pelvis", (0, 0, 0), IDENTITY,
         0.214, (0.003494, 0.000233, 0.018034), (0.000163531, 0.000107714, 0.000102205), (0.289697, 0.591001, -0.337795, 0.672821),
         Hinge("waist_yaw_joint", "Z", (-2.618, 2.618), 0.0103, 88.0)),
    Link("waist_roll_link", "waist_yaw_link", (-0.0039635, 0, 0.044), IDENTITY,
         0.086, (0, 2.3e-05, 0), (8.245e-06, 7.079e-06, 6.339e-06), (0.5, 0.5, -0.5, 0.5),
         Hinge("waist_roll_joint", "X", (-0.52, 0.52), 0.0103, 50.0)),
    Link("torso_link", "waist_roll_link", (0, 0, 0), IDENTITY,
         7.818, (0.00203158, 0.000339683, 0.184568), (0.121847, 0.109825, 0.0273735), (0.999803, -6.03319e-05, 0.0198256, 0.00131986),
         Hinge("waist_pitch_joint", "Y", (-0.52, 0.52), 0.0, 50.0)),
    Link("left_shoulder_pitch_link", "torso_link", (0.0039563, 0.10022, 0.24778), (0.990264, 0.139201, 1.38722e-05, -9.86868e-05),
         0.718, (0, 0.035892, -0.011628), (0.000465864, 0.000432842, 0.000406394), (0.654152, 0.0130458, -0.326267, 0.68225),
         Hinge("left_shoulder_pitch_joint", "Y", (-3.0892, 2.6704), 0.003597, 25.0)),
    Link("left_shoulder_roll_link", "left_shoulder_pitch_link", (0, 0.038, -0.013831), (0.990268, -0.139172, 0, 0),
         0.643, (-0.000227, 0.00727, -0.063243), (0.000691311, 0.000618011, 0.000388977), (0.701256, -0.0196223, -0.00710317, 0.712604),
         Hinge("left_shoulder_roll_joint", "X", (-1.5882, 2.2515), 0.003597, 25.0)),
    Link("left_shoulder_yaw_link", "left_shoulder_roll_link", (0, 0.00624, -0.1032), IDENTITY,
         0.734, (0.010773, -0.002949, -0.072009), (0.00106187, 0.00103217, 0.000400661), (0.716879, -0.0964829, -0.0679942, 0.687134),
         Hinge("left_shoulder_yaw_joint", "Z", (-2.618, 2.618), 0.003597, 25.0)),
    Link("left_elbow_link", "left_shoulder_yaw_link", (0.015783, 0, -0.080518), IDENTITY,
         0.6, (0.064956, 0.004454, -0.010062), (0.000443035, 0.000421612, 0.000259353), (0.541765, 0.636132, 0.388821, 0.388129),
         Hinge("left_elbow_joint", "Y", (-1.0472, 2.0944), 0.003597, 25.0)),
    Link("left_wrist_roll_link", "left_elbow_link", (0.1, 0.00188791, -0.01), IDENTITY,
         0.085445, (0.0171394, 0.000537591, 4.8864e-07), (5.48211e-05, 4.96646e-05, 3.57798e-05), (0.575338, 0.411667, -0.574906, 0.411094),
         Hinge("left_wrist_roll_joint", "X", (-1.97222, 1.97222), 0.0, 25.0)),
    Link("left_wrist_pitch_link", "left_wrist_roll_link", (0.038, 0, 0), IDENTITY,
         0.48405, (0.0229999, -0.00111685, -0.00111658), (0.000430353, 0.000429873, 0.000164648), (0.249998, 0.661363, 0.293036, 0.643608),
         Hinge("left_wrist_pitch_joint", "Y", (-1.61443, 1.61443), 0.0, 5.0)),
    Link("left_wrist_yaw_link", "left_wrist_pitch_link", (0.046, 0, 0), IDENTITY,
         0.457415, (0.0885506, 0.00212216, -0.000374562), (0.00105989, 0.000895419, 0.000323842), (0.487149, 0.493844, 0.513241, 0.505358),
         Hinge("left_wrist_yaw_joint", "Z", (-1.61443, 1.61443), 0.0, 5.0)),
    Link("left_hand_thumb_0_link", "left_wrist_yaw_link", (0.067, 0.003, 0), IDENTITY,
         0.0862366, (-0.000884246, -0.00863407, 0.000944293), (1.6546e-05, 1.60058e-05, 1.43741e-05), (0.462991, 0.643965, -0.460173, 0.398986),
         Hinge("left_hand_thumb_0_joint", "Y", (-1.0472, 1.0472), 0.01, 2.45)),
    Link("left_hand_thumb_1_link", "left_hand_thumb_0_link", (-0.0025, -0.0193, 0), IDENTITY,
         0.0588507, (-0.000827888, -0.0354744, -0.0003809), (1.28514e-05, 1.22902e-05, 5.9666e-06), (0.685598, 0.705471, -0.15207, 0.0956069),
         Hinge("left_hand_thumb_1_joint", "Z", (-0.724312, 1.0472), 0.01, 1.4)),
    Link("left_hand_thumb_2_link", "left_hand_thumb_1_link", (0, -0.0458, 0), IDENTITY,
         0.0203063, (-0.00171735, -0.0262819, 0.000107789), (4.61314e-06, 3.86645e-06, 1.53495e-06), (0.703174, 0.710977, -0.00017564, -0.00766553),
         Hinge("left_hand_thumb_2_joint", "Z", (0, 1.74533), 0.01, 1.4)),
    Link("left_hand_middle_0_link", "left_wrist_yaw_link", (0.1192, 0.0046, -0.0285), IDENTITY,
         0.0588507, (0.0354744, 0.000827888, 0.0003809), (1.28514e-05, 1.22902e-05, 5.9666e-06), (0.391313, 0.552395, 0.417187, 0.606373),
         Hinge("left_hand_middle_0_joint", "Z", (-1.5708, 0), 0.01, 1.4)),
    Link("left_hand_middle_1_link", "left_hand_middle_0_link", (0.0458, 0, 0), IDENTITY,
         0.0203063, (0.0262819, 0.00171735, -0.000107789), (4.61314e-06, 3.86645e-06, 1.53495e-06), (0.502612, 0.491799, 0.502639, 0.502861),
         Hinge("left_hand_middle_1_joint", "Z", (-1.74533, 0), 0.01, 1.4)),
    Link("left_hand_index_0_link", "left_wrist_yaw_link", (0.1192, 0.0046, 0.0285), IDENTITY,
         0.0588507, (0.0354744, 0.000827888, 0.0003809), (1.28514e-05, 1.22902e-05, 5.9666e-06), (0.391313, 0.552395, 0.417187, 0.606373),
         Hinge("left_hand_index_0_joint", "Z", (-1.5708, 0), 0.01, 1.4)),
    Link("left_hand_index_1_link", "left_hand_index_0_link", (0.0458, 0, 0), IDENTITY,
         0.0203063, (0.0262819, 0.00171735, -0.000107789), (4.61314e-06, 3.86645e-06, 1.53495e-06), (0.502612, 0.491799, 0.502639, 0.502861),
         Hinge("left_hand_index_1_joint", "Z", (-1.74533, 0), 0.01, 1.4)),
    Link("right_shoulder_pitch_link", "torso_link", (0.0039563, -0.10021, 0.24778), (0.990264, -0.139201, 1.38722e-05, 9.86868e-05),
         0.718, (0, -0.035892, -0.011628), (0.000465864, 0.000432842, 0.000406394), (0.68225, -0.326267, 0.0130458, 0.654152),
         Hinge("right_shoulder_pitch_joint", "Y", (-3.0892, 2.6704), 0.003597, 25.0)),
    Link("right_shoulder_roll_link", "right_shoulder_pitch_link", (0, -0.038, -0.013831), (0.990268, 0.139172, 0, 0),
         0.643, (-0.000227, -0.00727, -0.063243), (0.000691311, 0.000618011, 0.000388977), (0.712604, -0.00710317, -0.0196223, 0.701256),
         Hinge("right_shoulder_roll_joint", "X", (-2.2515, 1.5882), 0.003597, 25.0)),
    Link("right_shoulder_yaw_link", "right_shoulder_roll_link", (0, -0.00624, -0.1032), IDENTITY,
         0.734, (0.010773, 0.002949, -0.072009), (0.00106187, 0.00103217, 0.000400661), (0.687134, -0.0679942, -0.0964829, 0.716879),
         Hinge("right_shoulder_yaw_joint", "Z", (-2.618, 2.618), 0.003597, 25.0)),
    Link("right_elbow_link", "right_shoulder_yaw_link", (0.015783, 0, -0.080518), IDENTITY,
         0.6, (0.064956, -0.004454, -0.010062), (0.000443035, 0.000421612, 0.000259353), (0.388129, 0.388821, 0.636132, 0.541765),
         Hinge("right_elbow_joint", "Y", (-1.0472, 2.0944), 0.003597, 25.0)),
    Link("right_wrist_roll_link", "right_elbow_link", (0.1, -0.00188791, -0.01), IDENTITY,
         0.085445, (0.0171394, -0.000537591, 4.8864e-07), (5.48211e-05, 4.96646e-05, 3.57798e-05), (0.411667, 0.575338, -0.411094, 0.574906),
         Hinge("right_wrist_roll_joint", "X", (-1.97222, 1.97222), 0.0, 25.0)),
    Link("right_wrist_pitch_link", "right_wrist_roll_link", (0.038, 0, 0), IDENTITY,
         0.48405, (0.0229999, 0.00111685, -0.00111658), (0.000430353, 0.000429873, 0.000164648), (0.643608, 0.293036, 0.661363, 0.249998),
         Hinge("right_wrist_pitch_joint", "Y", (-1.61443, 1.61443), 0.0, 5.0)),
    Link("right_wrist_yaw_link", "right_wrist_pitch_link", (0.046, 0, 0), IDENTITY,
         0.457415, (0.0885506, -0.00212216, -0.000374562), (0.00105989, 0.000895419, 0.000323842), (0.505358, 0.513241, 0.493844, 0.487149),
         Hinge("right_wrist_yaw_joint", "Z", (-1.61443, 1.61443), 0.0, 5.0)),
    Link("right_hand_thumb_0_link", "right_wrist_yaw_link", (0.067, -0.003, 0), IDENTITY,
         0.0862366, (-0.000884246, 0.00863407, 0.000944293), (1.6546e-05, 1.60058e-05, 1.43741e-05), (0.643965, 0.462991, -0.398986, 0.460173),
         Hinge("right_hand_thumb_0_joint", "Y", (-1.0472, 1.0472), 0.01, 2.45)),
    Link("right_hand_thumb_1_link", "right_hand_thumb_0_link", (-0.0025, 0.0193, 0), IDENTITY,
         0.0588507, (-0.000827888, 0.0354744, -0.0003809), (1.28514e-05, 1.22902e-05, 5.9666e-06), (0.705471, 0.685598, -0.0956069, 0.15207),
         Hinge("right_hand_thumb_1_joint", "Z", (-1.0472, 0.724312), 0.01, 1.4)),
    Link("right_hand_thumb_2_link", "right_hand_thumb_1_link", (0, 0.0458, 0), IDENTITY,
         0.0203063, (-0.00171735, 0.0262819, 0.000107789), (4.61314e-06, 3.86645e-06, 1.53495e-06), (0.710977, 0.703174, 0.00766553, 0.00017564),
         Hinge("right_hand_thumb_2_joint", "Z", (-1.74533, 0), 0.01, 1.4)),
    Link("right_hand_middle_0_link", "right_wrist_yaw_link", (0.1192, -0.0046, -0.0285), IDENTITY,
         0.0588507, (0.0354744, -0.000827888, 0.0003809), (1.28514e-05, 1.22902e-05, 5.9666e-06), (0.606373, 0.417187, 0.552395, 0.391313),
         Hinge("right_hand_middle_0_joint", "Z", (0, 1.5708), 0.01, 1.4)),
    Link("right_hand_middle_1_link", "right_hand_middle_0_link", (0.0458, 0, 0), IDENTITY,
         0.0203063, (0.0262819, -0.00171735, -0.000107789), (4.61314e-06, 3.86645e-06, 1.53495e-06), (0.502861, 0.502639, 0.491799, 0.502612),
         Hinge("right_hand_middle_1_joint", "Z", (0, 1.74533), 0.01, 1.4)),
    Link("right_hand_index_0_link", "right_wrist_yaw_link", (0.1192, -0.0046, 0.0285), IDENTITY,
         0.0588507, (0.0354744, -0.000827888, 0.0003809), (1.28514e-05, 1.22902e-05, 5.9666e-06), (0.606373, 0.417187, 0.552395, 0.391313),
         Hinge("right_hand_index_0_joint", "Z", (0, 1.5708), 0.01, 1.4)),
    Link("right_hand_index_1_link", "right_hand_index_0_link", (0.0458, 0, 0), IDENTITY,
         0.0203063, (0.0262819, -0.00171735, -0.000107789), (4.61314e-06, 3.86645e-06, 1.53495e-06), (0.502861, 0.502639, 0.491799, 0.502612),
         Hinge("right_hand_index_1_joint", "Z", (0, 1.74533), 0.01, 1.4)),
)
# fmt: on
"""44 links: the pelvis and one a joint."""
