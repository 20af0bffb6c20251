"""A diffusers model as a policy: it denoises a chunk of actions. Its weights are random; load yours.

`python examples/callables/diffusers_policy.py` evaluates it; diffusers comes with the `study` extra.
"""

from lerobot_roborecover import evaluate, load_scenarios  # first: it pins how numpy rounds

# isort: split
import torch
from diffusers import DDIMScheduler, UNet1DModel

WIDTH, STEPS, STATE = 4, 32, 43  # of an action, of a chunk, of the two observations together
blocks = {"block_out_channels": (32, 64), "down_block_types": ("DownBlock1D", "AttnDownBlock1D")}
torch.manual_seed(0)
model = UNet1DModel(
    sample_size=STEPS,
    in_channels=WIDTH + STATE,
    out_channels=WIDTH,
    up_block_types=("AttnUpBlock1D", "UpBlock1D"),
    **blocks,
)  # UNet1DModel.from_pretrained(FOLDER)
scheduler = DDIMScheduler(num_train_timesteps=100)
scheduler.set_timesteps(5)


@torch.no_grad()
def policy(observation, instruction):
    """Returns a chunk (32, 4): noise from torch's global generator, which starts from the trial's seed."""
    state = torch.tensor([*observation["agent_pos"], *observation["environment_state"]], dtype=torch.float32)
    chunk = torch.randn(1, WIDTH, STEPS)
    for step in scheduler.timesteps:
        seen = torch.cat([chunk, state[None, :, None].expand(1, -1, STEPS)], dim=1)
        chunk = scheduler.step(model(seen, step).sample, step, chunk).prev_sample
    return chunk[0].T.clamp(-1, 1)


if __name__ == "__main__":
    scenarios = load_scenarios("metaworld_starter", select="cell=Place-*")
    rows = evaluate(policy, scenarios, name="diffusers", trials=1, env={"obs_type": "state"})
    print(f"recovered in {sum(row.success for row in rows)} of {len(rows)} trials")
