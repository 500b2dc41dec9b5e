"""A SAC trained on Pendulum with g = 9.81 m/s2 must go on with g = 11 m/s2 (or what you say), with little data.

python examples/quickstart_pendulum.py --gravity 11
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

import gymnasium as gym
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env

from sb3_rpto import RPTO
from sb3_rpto.dynamics.matmul_precision import fast_products
from sb3_rpto.evaluation.learning_curve import evaluate


def pendulum(g: float) -> gym.Env:
    return gym.make("Pendulum-v1", g=g)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--gravity", type=float, default=11.0, help="of the target, in m/s2")
    parser.add_argument("--steps", type=int, default=600, help="budget of target steps")
    parser.add_argument("--source-steps", type=int, default=8_000, help="steps that train the source policy")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("runs/pendulum"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)

    agent, data = arguments.out / "source.zip", arguments.out / "source_data.pkl"
    if not (agent.exists() and data.exists()):
        sac = SAC("MlpPolicy", pendulum(9.81), learning_rate=1e-3, seed=arguments.seed, device="cpu")
        with fast_products():
            sac.learn(arguments.source_steps, progress_bar=True)
        sac.save_replay_buffer(data)
        sac.save(agent)

    # The four lines that matter: a trained agent, its simulator, the new world, and a budget of steps there.
    model = RPTO.from_source(
        agent,
        pendulum(9.81),
        target_env=pendulum(arguments.gravity),
        source_data=data,
        dynamics_kwargs={"hidden": (128, 128, 128)},
        seed=arguments.seed,
        device="cpu",
    )
    check = make_vec_env(partial(pendulum, arguments.gravity), n_envs=20)
    zero_shot = evaluate(model, check, 20, seed=0)
    model.learn(arguments.steps, progress_bar=True)
    after = evaluate(model, check, 20, seed=0)

    print(f"target: Pendulum with g = {arguments.gravity:g} m/s2; 20 episodes each, the same starts")
    print(f"zero-shot return       {zero_shot:8.1f}")
    print(f"return after transfer  {after:8.1f}   ({model.num_timesteps} target steps)")


if __name__ == "__main__":
    main()
