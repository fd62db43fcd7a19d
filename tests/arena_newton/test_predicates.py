"""Predicates of every task in states made for them: each holds in some, fails in others, in the order of the task."""

from functools import cache
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import warp as wp

from arena_newton import rule_sets, tasks
from arena_newton.robot import g1
from arena_newton.tasks.handles import BodyFrame
from arena_newton.tasks.judge import above, below
from tests.scenes import scene


class Bench:
    """One world of a task on native MuJoCo, seen by its judge as the physics would show it."""

    def __init__(self, task: str, rules: str):
        """Build the judge."""
        rule_set, self.spec = rule_sets.get(rules), tasks.get(task)
        self.scene = scene(task)
        self.judge = self.spec.judge(self.scene, rule_set)
        self.draws = self.spec.draw(1, "base", rule_set)

    def start(self) -> mujoco.MjData:
        """An episode's first state."""
        self.latched, self.pressing = 1, 0.0
        h, data = self.scene.robot, mujoco.MjData(self.scene.mj_model)
        data.qpos[h.root_qpos : h.root_qpos + 7] = (*self.spec.spawn_position, *self.spec.spawn_quat)
        data.qpos[h.joint_qpos] = g1.DEFAULT_POSE
        for prim, pose in self.draws.placed.items():
            if self.scene.has_body(f"{prim}/Frame"):
                mocap = self.scene.mocap_id(prim)
                data.mocap_pos[mocap], data.mocap_quat[mocap] = pose.pos, pose.quat
            else:
                address = self.scene.joint_qpos(prim)
                data.qpos[address : address + 7] = (*pose.pos, *pose.quat)
        return self.forward(data)

    def forward(self, data: mujoco.MjData) -> mujoco.MjData:
        """Positions of bodies for the coordinates."""
        mujoco.mj_forward(self.scene.mj_model, data)
        return data

    def carry(self, data: mujoco.MjData, point, goal) -> None:
        """Move the robot, without turning it, so that a point of it comes to a goal."""
        root = self.scene.robot.root_qpos
        data.qpos[root : root + 3] += np.asarray(goal) - np.asarray(point)
        self.forward(data)

    def put(self, data: mujoco.MjData, prim: str, position) -> None:
        """Move a free object."""
        address = self.scene.joint_qpos(prim)
        data.qpos[address : address + 3] = position
        self.forward(data)

    def at(self, data: mujoco.MjData, prim: str) -> np.ndarray:
        """World position of a marker's centre."""
        marker = self.scene.marker(prim)
        return data.xpos[marker.body_id] + data.xmat[marker.body_id].reshape(3, 3) @ np.array(marker.pos)

    def palm(self, data: mujoco.MjData) -> np.ndarray:
        """World position of the right palm."""
        frame = self.scene.frame("right_hand_palm_link")
        return data.xpos[frame.body_id] + data.xmat[frame.body_id].reshape(3, 3) @ np.array(frame.pos)

    def holding(self, data: mujoco.MjData) -> list[str]:
        """Names of the predicates that hold."""

        def row(values, dtype=wp.float32):
            return wp.array(np.asarray(values)[None], dtype=dtype, device="cpu")

        forces = np.zeros(self.scene.mj_model.nbody)
        physics = SimpleNamespace(
            xpos=row(data.xpos),
            xquat=row(data.xquat),
            xipos=row(data.xipos),
            qpos=row(data.qpos),
            qvel=row(data.qvel),
            contact_force=row(forces),
            latch_locked=row(self.latched, wp.int32),
            pair_force=row(self.pressing),
            watch_pair=lambda *_: None,
        )
        self.judge.evaluate(physics)
        flags = self.judge.predicates.numpy()[0]
        assert set(flags) <= {0, 1} and flags[-1] == self.judge.success.numpy()[0]
        return [p.name for p, flag in zip(self.spec.predicates, flags, strict=True) if flag]


@cache
def bench(task: str, rules: str = "paper") -> Bench:
    """Built once per file."""
    return Bench(task, rules)


@pytest.mark.parametrize("rules", rule_sets.names())
@pytest.mark.parametrize("task", tasks.OWN)
def test_none_holds_at_the_start_and_a_reset_forgets(task, rules):
    """At the spawn pose no predicate holds, and a reset clears those of the masked worlds."""
    b = bench(task, rules)
    assert b.holding(b.start()) == []
    b.judge.predicates.fill_(1)
    b.judge.reset(wp.array([1], dtype=wp.int32, device="cpu"))
    assert not b.judge.predicates.numpy().any()


def test_football():
    """Root near the ball, a toe at it, the ball rolls to the goal, the ball is in it."""
    b = bench("football")
    data, foot = b.start(), b.scene.link("left_ankle_roll_link")
    ball = b.scene.body_id("/World/Ball")
    b.carry(data, data.xpos[b.scene.link("pelvis")], [*(data.xpos[ball] + [0.4, -0.5, 0.0])[:2], 0.8])
    assert b.holding(data) == ["approach"]
    toe = data.xpos[foot] + data.xmat[foot].reshape(3, 3) @ np.array([0.12, 0.0, -0.02])
    b.carry(data, toe, data.xpos[ball] + [0.0, -0.15, 0.0])
    assert b.holding(data) == ["approach", "contact"]
    speed = b.scene.joint_qvel("/World/Ball")
    data.qvel[speed + 1] = 1.0
    assert b.holding(data) == ["approach", "contact", "transport"]
    data.qvel[speed + 1] = -1.0
    b.put(data, "/World/Ball", b.at(data, "/World/Goal/Volume"))
    assert b.holding(data) == ["goal"]


def test_double_desk():
    """Root near the hammer, a palm at it, the hammer up, over the crate, in the crate."""
    b = bench("double_desk")
    data = b.start()
    hammer = data.qpos[b.scene.joint_qpos("/World/Hammer") :][:3].copy()
    b.carry(data, data.xpos[b.scene.link("pelvis")], [hammer[0], hammer[1] - 0.7, 0.8])
    assert b.holding(data) == ["approach"]
    b.carry(data, b.palm(data), hammer + [0.0, 0.0, 0.05])
    assert b.holding(data) == ["approach", "contact"]
    b.put(data, "/World/Hammer", hammer + [0.0, 0.0, 0.2])
    assert "lift" in b.holding(data) and "transport" not in b.holding(data)
    inside = b.at(data, "/World/Basket/Frame/Inside")
    b.put(data, "/World/Hammer", inside + [0.0, 0.0, 0.4])
    assert b.holding(data) == ["lift", "transport"]
    b.put(data, "/World/Hammer", inside - [0.0, 0.0, 0.05])
    assert b.holding(data) == ["place"]


def test_pp_box():
    """Root near the box, a palm at it, the box up, over the shelf, on a deck, released, at rest for ten ticks."""
    b = bench("pp_box")
    data = b.start()
    box = data.qpos[b.scene.joint_qpos("/World/Box") :][:3].copy()
    b.carry(data, data.xpos[b.scene.link("pelvis")], [box[0] - 0.7, box[1], 0.8])
    assert b.holding(data) == ["approach"]
    b.carry(data, b.palm(data), box + [0.0, 0.0, 0.25])
    assert b.holding(data) == ["approach", "contact"]
    b.put(data, "/World/Box", box + [0.0, 0.0, 0.2])
    assert "lift" in b.holding(data) and "transport" not in b.holding(data)
    deck = b.at(data, "/World/Shelf/Frame/Deck_1")
    b.put(data, "/World/Box", deck + [0.0, 0.0, 0.3])
    assert b.holding(data) == ["lift", "transport"]
    b.put(data, "/World/Box", deck + [0.0, 0.0, 0.03])
    b.carry(data, b.palm(data), deck + [0.0, 0.0, 0.25])
    assert b.holding(data)[-3:] == ["contact", "transport", "place"]
    b.carry(data, b.palm(data), deck + [-1.0, -1.0, 0.25])
    b.pressing = 0.1
    held = [b.holding(data) for _ in range(10)]
    assert held[-1][-1] == "release"
    b.pressing = 0.0
    held = [b.holding(data) for _ in range(10)]
    assert held[0][-2:] == ["place", "release"] and held[-1][-1] == "hold"


@pytest.mark.parametrize(("rules", "last"), [("paper", ["open"]), ("released", ["open", "pass"])])
def test_open_door(rules, last):
    """Root near the doorway, a palm at the handle, the latch released, the leaf open, and the rule set's end."""
    b = bench("open_door", rules)
    data = b.start()
    doorway = b.at(data, "/World/Door/Frame/Doorway")
    b.carry(data, data.xpos[b.scene.link("pelvis")], [*(doorway + [0.0, -0.7, 0.0])[:2], 0.8])
    assert b.holding(data) == ["approach"]
    handle = data.xpos[b.scene.body_id("/World/Door/Handle")]
    b.carry(data, b.palm(data), handle + [-0.05, -0.05, 0.0])
    assert b.holding(data) == ["approach", "contact"]
    b.latched = 0
    assert b.holding(data) == ["approach", "contact", "unlatch"]
    data.qpos[b.scene.joint_qpos("/World/Door/LeafHinge")] = np.radians(65.0)
    b.forward(data)
    assert [name for name in b.holding(data) if name in ("open", "pass")] == last
    b.carry(data, data.xpos[b.scene.link("pelvis")], [*(doorway + [0.0, 0.2, 0.0])[:2], 0.8])
    assert b.holding(data)[-1] == "pass"


def test_sit_sofa():
    """Root near the seat, back to it, weight on it, for half a second."""
    b = bench("sit_sofa")
    data, root = b.start(), b.scene.robot.root_qpos
    seat = b.at(data, "/World/Sofa/Seat")
    b.carry(data, data.xpos[b.scene.link("pelvis")], [*(seat + [0.0, 0.9, 0.0])[:2], 0.8])
    assert b.holding(data) == ["approach"]
    data.qpos[root + 3 : root + 7] = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))
    b.forward(data)
    assert b.holding(data) == ["approach", "turn"]
    data.qpos[root + 2], b.pressing = 0.5, 80.0
    b.forward(data)
    held = [b.holding(data) for _ in range(25)]
    assert held[0] == ["approach", "turn", "contact"] and held[-1] == ["approach", "turn", "contact", "sit"]


def test_boxing():
    """Root near the target, a palm at it."""
    b = bench("boxing")
    data = b.start()
    target = b.at(data, "/World/Target/Frame/Bounds")
    b.carry(data, data.xpos[b.scene.link("pelvis")], [target[0], target[1] + 0.7, 0.8])
    assert b.holding(data) == ["approach"]
    b.carry(data, b.palm(data), target)
    assert b.holding(data)[-1] == "contact"


def test_vis_navi():
    """Root near the marked area, a foot in it, both feet in it."""
    b = bench("vis_navi")
    data = b.start()
    zone = b.at(data, "/World/TargetSign/Frame/Zone")
    pelvis = b.scene.link("pelvis")
    b.carry(data, data.xpos[pelvis], [zone[0], zone[1] - 1.1, 0.8])
    assert b.holding(data) == ["approach"]
    b.carry(data, data.xpos[b.scene.link("left_ankle_roll_link")], [zone[0] + 0.45, zone[1], 0.05])
    assert b.holding(data) == ["approach", "enter"]
    b.carry(data, data.xpos[pelvis], [zone[0], zone[1], 0.8])
    assert b.holding(data) == ["approach", "enter", "stand"]


def test_conditions_must_match_the_predicates():
    """A judge whose conditions are not those of its task's predicates is refused."""
    from arena_newton.errors import InputError
    from arena_newton.tasks.judge import Judge

    with pytest.raises(InputError, match="predicates success: conditions are given for approach"):
        Judge(bench("boxing").scene, conditions={"approach": []})


def test_above_and_below_meet():
    """Everything is above or below a height: the two boxes share that face and reach beyond any scene."""
    point = BodyFrame(1, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    (high,), (low,) = above(point, 0.3).boxes, below(point, 0.3).boxes
    assert high.pos[2] - high.half[2] == pytest.approx(0.3) == low.pos[2] + low.half[2]
    assert low.pos[2] - low.half[2] < -20.0 and high.pos[2] + high.half[2] > 20.0
