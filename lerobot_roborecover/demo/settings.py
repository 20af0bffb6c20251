"""What a demo run is asked to do, and what of it must stay the same when it is rerun in the same folder."""

from __future__ import annotations

import importlib.resources
import json
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from lerobot_roborecover.demo import DemoError
from lerobot_roborecover.policies.identity import policy_identity
from lerobot_roborecover.utils.atomic_io import atomic_write
from lerobot_roborecover.utils.journal import InUseError, open_locked
from lerobot_roborecover.utils.options import internal, option

SCENARIOS = "metaworld_starter"
TRIALS = 1
"""The shipped policy and the simulators are deterministic: more trials of a scenario repeat the first."""
_FILE = "demo.json"
_SCHEMA = 1


def shipped_policy() -> Path:
    """Folder of the policy that comes with this package.

    Raises:
        DemoError: this installation has none.
    """
    folder = Path(str(importlib.resources.files("lerobot_roborecover").joinpath("data", "metaworld_act")))
    if not (folder / "config.json").is_file():
        raise DemoError(
            f"this installation has no shipped policy ({folder}). Install lerobot_env_roborecover again, or "
            "name a policy: --policy.path=FOLDER_OR_HUB_ID"
        )
    return folder


@dataclass(frozen=True)
class DemoSettings:
    """One demo run."""

    out: Path = Path("outputs/demo")
    """Folder of the results; rerun to go on."""
    policy: str = option("", name="policy.path", metavar="POLICY", show_default=False, checkpoint=True)
    """Folder or Hub id of another Meta-World policy.

    Empty: the shipped one, whose folder stands here then.
    """
    scenarios: str = option(SCENARIOS, show_default=False)
    """Another scenario set: shipped name, folder or Hub id."""
    select: str = ""
    """Which scenarios, e.g. 'cell=Approach-*; source=natural'."""
    limit: int | None = None
    """At most this many scenarios, spread over the set."""
    trials: int = option(TRIALS, show_default=False)
    """Trials per scenario and start (default: 1, the shipped policy is deterministic)."""
    obs_type: str = "state"
    """What that policy sees: state, pixels, pixels_agent_pos.

    `state` renders nothing.
    """
    pictures: bool = True
    """Write the page without recovery frames."""
    program: tuple[str, ...] = internal(())
    """What to run as `lerobot-eval`; empty: the one of this Python."""

    def __post_init__(self):
        if not self.policy:
            object.__setattr__(self, "policy", str(shipped_policy()))
        if self.trials < 1:
            raise DemoError(f"--trials {self.trials}: at least 1 trial per scenario is needed")
        if self.limit is not None and self.limit < 1:
            raise DemoError(f"--limit {self.limit}: at least 1 scenario is needed")

    @property
    def trial_log(self) -> Path:
        """The one log of both starts."""
        return self.out / "trials.jsonl"


def claim_folder(settings: DemoSettings) -> None:
    """Makes the output folder, or checks that what lies in it is of the same policy and scenarios.

    Raises:
        DemoError: the folder holds results of another run, or cannot be written.
    """
    fixed = {
        "schema": _SCHEMA,
        "policy": settings.policy,
        "identity": policy_identity(settings.policy),
        "scenarios": settings.scenarios,
        "obs_type": settings.obs_type,
    }
    path = settings.out / _FILE
    try:
        settings.out.mkdir(parents=True, exist_ok=True)
        if path.exists():
            found = json.loads(path.read_text(encoding="utf-8"))
            other = [key for key in fixed if found.get(key) != fixed[key]]
            if other:
                raise DemoError(
                    f"{settings.out} holds a demo with {other[0]} {found.get(other[0])!r}, "
                    f"not {fixed[other[0]]!r}. Give this one a folder of its own: --out FOLDER"
                )
            return
        atomic_write(path, json.dumps(fixed, indent=2) + "\n")
    except (OSError, ValueError, AttributeError) as err:
        raise DemoError(
            f"cannot use {settings.out} for the demo's output: {err}. Choose another with --out"
        ) from None


@contextmanager
def hold_folder(settings: DemoSettings) -> Generator[None]:
    """Claims the output folder, and keeps other demos out of it until the block ends.

    Raises:
        DemoError: see `claim_folder`; or another demo is at work in the folder.
    """
    claim_folder(settings)
    try:
        lock = open_locked(settings.out / ".lock", "a")
    except InUseError:
        raise DemoError(
            f"another demo is at work in {settings.out}. Wait for it, or give this one a folder of its own: "
            "--out FOLDER"
        ) from None
    except OSError as err:
        raise DemoError(f"cannot write to {settings.out}: {err}. Choose another with --out") from None
    with lock:
        yield
