"""Recovery as a curve beside the loss: a training loop that evaluates its policy every so many steps.

    python examples/training/evaluate_while_training.py                # prints what would be logged
    python examples/training/evaluate_while_training.py --log wandb    # or trackio, where you have one

The policy is a small ACT on Meta-World's low-dimensional observations, and learns from the states and actions
that the scenarios' own prefixes go through: too little to solve anything, enough to show the loop. No account
and no download are needed.
"""

from __future__ import annotations

import lerobot_roborecover as roborecover  # first: it pins how numpy rounds

# isort: split
import argparse
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gymnasium
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies import get_policy_class, make_policy_config, make_pre_post_processors

CHUNK = 8


def printed(metrics: dict[str, float], step: int) -> None:
    """Takes the call that `wandb.log` and `trackio.log` take."""
    print(f"step {step}: " + ", ".join(f"{name} {value:.3g}" for name, value in metrics.items()))


def tracker(name: str) -> Callable[..., Any]:
    """Where metrics go: `wandb.log`, `trackio.log`, or the terminal."""
    if name == "print":
        return printed
    module = __import__(name)
    module.init(project="recovery")
    return module.log


def demonstrations(scenarios: list[roborecover.Scenario]) -> dict[str, torch.Tensor]:
    """States and the chunks of actions that followed them, from the scenarios' prefixes."""
    batch: dict[str, list] = {"observation.state": [], "observation.environment_state": [], "action": []}
    for scenario in scenarios:
        env = gymnasium.make(
            "roborecover/Metaworld-v0", scenario=scenario, start="initial", obs_type="state",
            disable_env_checker=True,
        )  # fmt: skip
        observation, _ = env.reset()
        actions = torch.tensor(scenario.prefix, dtype=torch.float32)
        for step in range(len(actions) - CHUNK):
            batch["observation.state"].append(torch.as_tensor(observation["agent_pos"]))
            batch["observation.environment_state"].append(torch.as_tensor(observation["environment_state"]))
            batch["action"].append(actions[step : step + CHUNK])
            observation, *_ = env.step(scenario.prefix[step])
        env.close()
    return {key: torch.stack(values).float() for key, values in batch.items()}


def small_act(data: dict[str, torch.Tensor]) -> tuple[Any, tuple[Any, Any]]:
    """A policy and its processors, which hold the data's statistics."""
    kinds = {"observation.state": FeatureType.STATE, "observation.environment_state": FeatureType.ENV}
    config = make_policy_config(
        "act",
        input_features={key: PolicyFeature(kind, (data[key].shape[-1],)) for key, kind in kinds.items()},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (data["action"].shape[-1],))},
        device="cuda" if torch.cuda.is_available() else "cpu",
        push_to_hub=False, chunk_size=CHUNK, n_action_steps=CHUNK, dim_model=32, n_heads=2,
        dim_feedforward=64, n_encoder_layers=1, use_vae=False, pretrained_backbone_weights=None,
    )  # fmt: skip
    flat = {key: values.flatten(0, -2) for key, values in data.items()}
    stats = {key: {"mean": v.mean(0), "std": v.std(0) + 1e-3} for key, v in flat.items()}
    processors = make_pre_post_processors(config, dataset_stats=stats)
    return get_policy_class("act")(config).to(config.device), processors


def main(argv: list[str] | None = None) -> list[dict[str, float]]:
    """Trains, and evaluates on the way; returns what was logged."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--eval-freq", type=int, default=100)
    parser.add_argument("--scenarios", type=int, default=4, help="of the shipped Meta-World set")
    parser.add_argument("--horizon", type=int, help="steps of a trial, for a quick look (the task's own)")
    parser.add_argument("--log", choices=("print", "wandb", "trackio"), default="print")
    args = parser.parse_args(argv)

    scenarios = list(roborecover.load_scenarios("metaworld_starter")[: args.scenarios])
    data = demonstrations(scenarios)
    if args.horizon:
        scenarios = [replace(s, task=replace(s.task, horizon=args.horizon)) for s in scenarios]
    policy, processors = small_act(data)
    callback = roborecover.EvaluationCallback(
        scenarios,
        args.eval_freq,
        tracker(args.log),
        starts=("recovery", "initial"),
        options={"env": {"obs_type": "state"}, "trials": 1, "progress": False},
    )
    optimizer = torch.optim.AdamW(policy.parameters(), lr=1e-3)
    logged = []
    policy.train()
    for step in range(1, args.steps + 1):
        rows = torch.randint(len(data["action"]), (32,))
        batch = processors[0]({key: values[rows] for key, values in data.items()})
        batch["action_is_pad"] = torch.zeros(len(rows), CHUNK, dtype=torch.bool, device=policy.config.device)
        loss, _ = policy.forward(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        logged += [found] if (found := callback(step, policy, processors)) else []
    return logged


if __name__ == "__main__":
    main()
