"""A JAX model as a policy. Its weights are random; load yours.

`python examples/callables/jax_policy.py` evaluates it, where JAX is installed (`pip install jax`).
"""

from lerobot_roborecover import evaluate, load_scenarios  # first: it pins how numpy rounds

# isort: split
import jax
import jax.numpy as jnp

keys = jax.random.split(jax.random.key(0), 2)
weights = [jax.random.normal(keys[0], (43, 64)) / 8, jax.random.normal(keys[1], (64, 4)) / 8]


@jax.jit
def network(weights, state):
    """Returns an action (4,) from a state (43,)."""
    return jnp.tanh(jnp.tanh(state @ weights[0]) @ weights[1])


def policy(observation, instruction):
    """Returns the next action (4,)."""
    state = [*observation["agent_pos"], *observation["environment_state"]]
    return network(weights, jnp.asarray(state, jnp.float32))


if __name__ == "__main__":
    scenarios = load_scenarios("metaworld_starter", select="cell=Place-*")
    rows = evaluate(policy, scenarios, name="jax_mlp", trials=1, env={"obs_type": "state"})
    print(f"recovered in {sum(row.success for row in rows)} of {len(rows)} trials")
