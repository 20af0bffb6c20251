"""Meta-World's scripted experts as a policy: `python examples/callables/scripted_expert.py`."""

from lerobot_roborecover import evaluate, load_scenarios  # first: it pins how numpy rounds

# isort: split
import numpy as np
from metaworld.policies import ENV_POLICY_MAP

scenarios = load_scenarios("metaworld_starter", select="cell=Place-*")
experts = {scenario.task.instruction: ENV_POLICY_MAP[scenario.task.name]() for scenario in scenarios}


def policy(observation, instruction):
    """Returns the next action (4,) of the task's expert, from Meta-World's own observation (39,)."""
    return np.clip(experts[instruction].get_action(observation["environment_state"]), -1.0, 1.0)


if __name__ == "__main__":
    rows = evaluate(policy, scenarios, name="scripted_expert", trials=1, env={"obs_type": "state"})
    print(f"recovered in {sum(row.success for row in rows)} of {len(rows)} trials")
