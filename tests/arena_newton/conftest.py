"""A task that is not the paper's: registered for one test, with a scene and a judge of its own."""

import dataclasses

import pytest
import warp as wp

from arena_newton import tasks
from arena_newton.rules import rule_types
from arena_newton.tasks.judge import Judge

LAYER = """#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 1
    kilogramsPerUnit = 1
    upAxis = "Z"
    subLayers = [@arena_newton/usd_scenes/lab/scene.usda@]
)

over "World"
{
    def Xform "Bell"
    {
        float3 arena:size = (1, 1, 1)
    }
}
"""


@dataclasses.dataclass(frozen=True)
class Ringing(rule_types.SuccessRule):
    """Number of rings that success takes."""

    times: int = 3

    def sentence(self):
        """Condition in words."""
        return f"the bell rings {self.times} times"


class BellJudge(Judge):
    """The bell never rings."""

    def __init__(self, scene, rule_set):
        """Find the bell."""
        super().__init__(scene)
        self.bell = scene.marker("/World/Bell")

    def decide(self, physics):
        """Not yet."""
        self.margin.fill_(-1.0)
        wp.copy(self.success, wp.zeros_like(self.success))


@pytest.fixture
def bell(tmp_path):
    """Name of a registered task `bell`; unregistered after the test."""
    folder = tmp_path / "bell"
    folder.mkdir()
    (folder / "scene.usda").write_text(LAYER, encoding="utf-8")
    tasks.register(
        tasks.TaskSpec(
            name="bell",
            gym_id="Ring-The-Bell",
            instruction="Ring the bell.",
            spawn_position=(0.0, 0.0, 0.8),
            spawn_quat=(1.0, 0.0, 0.0, 0.0),
            requires=(tasks.Required("/World/Bell", "marker"),),
            scene=folder / "scene.usda",
            objects=(),
            steps=rule_types.ByRules.same(100),
            success=rule_types.ByRules.same(Ringing()),
            judge=BellJudge,
            semantic_variant=rule_types.ByRules.same("base"),
        )
    )
    yield "bell"
    tasks.unregister("bell")
