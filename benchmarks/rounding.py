"""What a processor's kernels do to the recorded states: handoffs of a shipped set under several of them.

    python benchmarks/rounding.py --set metaworld_starter
    python benchmarks/rounding.py --set libero_starter --core-types Haswell SkylakeX

A core type that the processor lacks ends the process that uses it; its line says so.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys

from lerobot_roborecover.utils.determinism import CORE_TYPE, VARIABLE


def one(name: str, every: int) -> dict:
    """Replays the set's scenarios in this process."""
    from lerobot_roborecover import load_scenarios
    from lerobot_roborecover.platforms import make_simulator
    from lerobot_roborecover.replay.handoff import hand_off
    from lerobot_roborecover.utils.determinism import core_type_in_use

    scenarios = list(load_scenarios(name))[::every]
    simulator = make_simulator(scenarios[0].platform, obs_type="state")
    identical, errors = 0, []
    for scenario in scenarios:
        handoff = hand_off(simulator, scenario)
        identical += handoff.state_sha256 == scenario.fingerprint.state_sha256
        errors.append(max(handoff.eef_error_mm, handoff.object_error_mm))
    simulator.close()
    errors.sort()
    return {
        "in_use": core_type_in_use(), "scenarios": len(scenarios), "identical": identical,
        "largest_mm": errors[-1], "second_largest_mm": errors[-2] if len(errors) > 1 else 0.0,
    }  # fmt: skip


def main() -> None:
    """Prints a line a core type."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--set", default="metaworld_starter")
    parser.add_argument("--core-types", nargs="+", default=[CORE_TYPE, "Zen", "SkylakeX", "Sandybridge"])
    parser.add_argument("--every", type=int, default=1, help="take every n-th scenario")
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.one:
        print(json.dumps(one(args.set, args.every)))
        return
    for core_type in args.core_types:
        command = [sys.executable, "-W", "ignore", __file__, "--one", "--set", args.set]
        done = subprocess.run(
            [*command, "--every", str(args.every)],
            env={**os.environ, VARIABLE: core_type}, capture_output=True, text=True,
        )  # fmt: skip
        lines = done.stdout.splitlines()
        said = lines[-1] if done.returncode == 0 else f"exit status {done.returncode}"
        print(f"{core_type}: {said}", flush=True)


if __name__ == "__main__":
    main()
