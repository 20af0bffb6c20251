"""`--runner.cross_cpu_deterministic`: a diffusion policy's noise schedule rounds alike on every processor."""

from __future__ import annotations

import copy

import pytest

from tests.support.factories import save_policy

pytestmark = pytest.mark.lerobot


@pytest.fixture(scope="module")
def load(tmp_path_factory):
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.policies.factory import get_policy_class

    def made(kind: str):
        folder = save_policy(tmp_path_factory.mktemp(kind), kind)
        config = PreTrainedConfig.from_pretrained(folder)
        config.device = "cpu"
        return get_policy_class(kind).from_pretrained(folder, config=config).eval()

    return made


def ask(policy):
    import torch

    shape = {"observation.state": 4, "observation.environment_state": 6}
    steps = policy.config.n_obs_steps
    rng = torch.Generator().manual_seed(1)
    batch = {name: torch.rand((1, steps, width), generator=rng) for name, width in shape.items()}
    torch.manual_seed(2)
    with torch.inference_mode():
        return policy.diffusion.generate_actions(batch)


def test_roots_of_the_schedule_are_correctly_rounded(load):
    import torch

    from lerobot_roborecover.policies.determinism import make_cross_cpu_deterministic

    policy = load("diffusion")
    stock = copy.deepcopy(policy)
    assert make_cross_cpu_deterministic(policy) == 1
    scheduler, before = policy.diffusion.noise_scheduler, stock.diffusion.noise_scheduler
    values = scheduler.alphas_cumprod
    assert torch.equal(values.float(), before.alphas_cumprod), "the schedule itself is the same"
    exact = [(float(v) ** 0.5) for v in values]  # Python's is correctly rounded
    assert (values**0.5).float().tolist() == torch.tensor(exact, dtype=torch.float64).float().tolist()
    # What the policy does is the same but for rounding, and still float32.
    one, other = ask(policy), ask(stock)
    assert one.dtype == other.dtype == torch.float32
    assert torch.allclose(one, other, atol=1e-5)


def test_policies_without_a_schedule_are_left_alone(load):
    from lerobot_roborecover.policies.determinism import make_cross_cpu_deterministic

    assert make_cross_cpu_deterministic(load("act")) == 0


def test_members_of_a_composite_are_found(load):
    import torch

    from lerobot_roborecover.policies.determinism import make_cross_cpu_deterministic

    composite = torch.nn.Linear(1, 1)
    composite.policies = [load("act"), load("diffusion")]
    assert make_cross_cpu_deterministic(composite) == 1
