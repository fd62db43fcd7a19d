"""A USD variant: a green sofa under warm light, in a layer of your own; rules and policies stay as they are.

Shows: that a scene is data. The layer sublayers the task's scene and says only what is different; it is validated,
looked at and run without a line of code. All about it is in docs/howto/bring/authoring.md.

    python examples/usd_variant.py --out usd_variant
"""

import argparse
from pathlib import Path

from arena_newton import ArenaEnv, Rollout, policies, trackers
from arena_newton.eval.plan.episode_plan import expand
from arena_newton.usd_scenes import preview, validate

LAYER = """#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 1
    kilogramsPerUnit = 1
    upAxis = "Z"
    subLayers = [@arena_newton/usd_scenes/sit_sofa/scene.usda@]
)

over "World"
{
    over "Looks"
    {
        over "Sofa"
        {
            over "Surface"
            {
                color3f inputs:diffuseColor = (0.1, 0.35, 0.15)
                color3f inputs:diffuseColor.connect = None
            }
        }
    }
    over "Light"
    {
        color3f inputs:color = (1, 0.85, 0.6)
    }
}
"""


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", default="usd_variant", type=Path, help="folder of layer and picture")
    parser.add_argument("--max-steps", type=int, default=None, help="ticks of 0.02 s; the task's own budget by default")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    layer = args.out / "green_sofa.usda"
    layer.write_text(LAYER)
    validate.check(layer, "sit_sofa")  # an error names file and prim
    print(preview.preview([str(layer)], args.out / "green_sofa.png"))
    env = ArenaEnv("sit_sofa", tracker=trackers.get("twist2"), worlds=1, engine="mujoco", variant_file=str(layer))
    episodes = expand(["sit_sofa"], trackers=["twist2"], policy="expert", seeds=[0], repeats=1)
    (result,) = Rollout(env, policies.get("expert"), episodes, max_steps=args.max_steps).run()
    print(f"the expert on the green sofa: {result.outcome} after {result.steps * 0.02:.1f} s")
    env.close()
