"""`roborecover curate screen`."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

from lerobot_roborecover.curation.screen.dataset import ScreenRequest
from lerobot_roborecover.utils.determinism import pin_policy_kernels
from lerobot_roborecover.utils.options import option

HELP = (
    "Run screening policies from every scenario's recovery point and keep the scenarios of intermediate "
    "difficulty."
)


@dataclass(frozen=True, kw_only=True)
class ScreenOptions(ScreenRequest):
    """What to screen; policies and their options as they are written on a command line."""

    policy: tuple[str, ...] = option((), metavar="[NAME=]CHECKPOINT", checkpoint=True)
    """A screening policy, folder or Hub id; give it again for each (the paper has four)."""
    env_option: tuple[str, ...] = option((), name="env", metavar="[NAME:]KEY=VALUE")
    """Option of the recovery env type, for one policy where its name stands before it; may be given again."""
    policy_option: tuple[str, ...] = option((), metavar="[NAME:]KEY=VALUE")
    """The same of the policy's config, e.g. act:n_action_steps=10."""
    rename_map: tuple[str, ...] = option((), metavar="[NAME:]JSON")
    """The env's observation keys to the policy's, as --rename_map of lerobot-eval."""

    def request(self) -> ScreenRequest:
        """Returns what to screen, the policies read."""
        from lerobot_roborecover.curation.screen.runs import parse_policies

        policies, env = parse_policies(self.policy, self.policy_option, self.env_option, self.rename_map)
        shared: dict[str, Any] = {field.name: getattr(self, field.name) for field in fields(ScreenRequest)}
        return replace(ScreenRequest(**shared), policies=policies, env=env)


OPTIONS = ScreenOptions


def run(options: ScreenOptions) -> int:
    """Screens, and prints the tables and the funnel."""
    pin_policy_kernels()  # outcomes of these trials are compared with those of a study
    from lerobot_roborecover.curation.screen.dataset import describe, screen_dataset
    from lerobot_roborecover.utils.progress import Progress

    request = options.request()
    print(describe(request, screen_dataset(request, Progress("trial").of)))
    return 0
