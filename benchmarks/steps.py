"""How many steps a second the Gymnasium environment makes: alone with a new world for each episode,
alone with worlds that are kept, and as many in one process.

    python benchmarks/steps.py --world pillar --difficulty easy

Processor time; all take turns, so that they meet the same machine. The policy flies straight to the
goal. Kept worlds are drawn before.
"""

from collections.abc import Callable
from typing import Any

import gymnasium
import measuring
import numpy as np

import scenegen  # noqa: F401  # so that gymnasium knows the environment

NAME = "scenegen/Fly-v0"


class Options(measuring.Options):
    """What is measured."""

    world: str = "pillar"
    difficulty: str = "easy"
    worlds: int = 32
    """worlds that are kept"""
    envs: int = 16
    """environments in one process"""
    steps: int = 480
    """of all environments together, in a round"""
    rounds: int = 5


def flier(env: Any, steps: int) -> Callable[[], None]:
    """Fly `steps` of one environment, or of several in one; each round goes on where the last
    ended."""
    many = getattr(env, "num_envs", 0)
    seen = [env.reset(seed=0)[0]]

    def fly() -> None:
        for _ in range(steps // max(many, 1)):
            away = seen[0]["goal"] - seen[0]["position"]
            away *= 2.0 / np.linalg.norm(away, axis=-1, keepdims=True)
            action = np.concatenate([away, np.zeros_like(away[..., :1])], axis=-1)
            seen[0], _, ended, over, _ = env.step(action.astype(np.float32))
            if not many and (ended or over):
                seen[0] = env.reset()[0]

    return fly


def main() -> None:
    """Measure in turn, and print."""
    given = measuring.parse(Options, worlds=1, envs=2, steps=8, rounds=1)
    options: Any = {"world": given.world, "difficulty": given.difficulty}
    kept = options | {"worlds": given.worlds}
    single = gymnasium.make(NAME, **kept)
    for seed in range(given.worlds):
        single.reset(options={"seed": seed})
    many = gymnasium.make_vec(NAME, given.envs, vectorization_mode="sync", **kept)
    ways = {
        "new worlds": flier(gymnasium.make(NAME, **options), given.steps),
        "kept worlds": flier(single, given.steps),
        f"kept worlds, {given.envs} environments": flier(many, given.steps),
    }
    times = measuring.in_turn(ways, given.rounds)
    base = times["new worlds"].processor
    for name, (wall, processor) in times.items():
        print(
            f"{name:30} {given.steps / processor * 1e3:7.0f} steps a second of processor time, "
            f"{base / processor:.1f} times; {given.steps / wall * 1e3:.0f} of wall time"
        )


if __name__ == "__main__":
    main()
