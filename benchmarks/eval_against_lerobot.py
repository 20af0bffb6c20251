"""`roborecover eval` against plain `lerobot-eval` on the same trials: the same outcomes, and how much sooner.

    python benchmarks/eval_against_lerobot.py --env roborecover_metaworld --scenarios 40 --trials 5
    python benchmarks/eval_against_lerobot.py --env roborecover_libero --scenarios 8 --trials 3

A random image policy (ACT) that executes `--actions` actions per inference runs both ways, in turns. Times
are from the opening of the trial log, after LeRobot's import, to its last row: checkpoint load and simulator
start are in both. LeRobot evaluates one scenario's trials as a batch (`--eval.batch_size` = trials), with its
simulators in worker processes.

With `--work` the same command goes on where it was stopped: a run that has ended is not repeated; one that
was cut off begins again, because half a run has no time.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from datetime import datetime
from pathlib import Path

from lerobot_roborecover import load_scenarios
from lerobot_roborecover.datasets import write_scenarios
from lerobot_roborecover.logs.row import TrialRow
from lerobot_roborecover.logs.trial_log import read_trial_log

WIDTHS = {"roborecover_libero": (8, 7), "roborecover_metaworld": (4, 4)}
"""State and action of each platform."""
IMAGES = {
    "roborecover_libero": ("observation.images.image", "observation.images.image2"),
    "roborecover_metaworld": ("observation.image",),
}


def save_policy(folder: Path, env: str, size: int, actions: int) -> Path:
    """A small random ACT on pictures, saved as `lerobot-train` would."""
    import torch
    from lerobot.configs import FeatureType, PolicyFeature
    from lerobot.policies import get_policy_class, make_policy_config, make_pre_post_processors

    state, action = WIDTHS[env]
    inputs = {name: PolicyFeature(FeatureType.VISUAL, (3, size, size)) for name in IMAGES[env]}
    inputs["observation.state"] = PolicyFeature(FeatureType.STATE, (state,))
    outputs = {"action": PolicyFeature(FeatureType.ACTION, (action,))}
    config = make_policy_config(
        "act", input_features=inputs, output_features=outputs, device="cpu", push_to_hub=False,
        chunk_size=actions, n_action_steps=actions, dim_model=32, n_heads=2, dim_feedforward=32,
        n_encoder_layers=1, use_vae=False, pretrained_backbone_weights=None,
    )  # fmt: skip
    torch.manual_seed(0)
    policy = get_policy_class("act")(config)
    widths = {"observation.state": (state,), "action": (action,)}
    widths |= dict.fromkeys(IMAGES[env], (3, 1, 1))
    stats = {k: {"mean": torch.zeros(s), "std": torch.ones(s)} for k, s in widths.items()}
    for part in (policy, *make_pre_post_processors(config, dataset_stats=stats)):
        part.save_pretrained(folder)
    return folder


def timed(command: list[str], out: Path) -> tuple[float, dict, float]:
    """Seconds from a run's trial log to its last row, the outcome of each, and the load when it began; of a
    run that has ended before, what it took then."""
    log, finished = out / "trials.jsonl", out.with_suffix(".json")
    if finished.exists():
        took, load = json.loads(finished.read_text())
        return took, {(r.scenario_id, r.trial): outcome(r) for r in read_trial_log(log)}, load
    shutil.rmtree(out, ignore_errors=True)
    load = os.getloadavg()[0]
    with tempfile.TemporaryFile("w+") as errors:
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=errors, text=True)
        while not log.exists() and process.poll() is None:
            time.sleep(0.02)
        began = time.time()
        if process.wait():
            errors.seek(0)
            sys.exit(f"{' '.join(command)}\n{errors.read()[-3000:]}")
    rows = read_trial_log(log)
    ended = max(datetime.fromisoformat(r.finished_at).timestamp() for r in rows)
    finished.write_text(json.dumps([ended - began, load]))
    return ended - began, {(r.scenario_id, r.trial): outcome(r) for r in rows}, load


def outcome(row: TrialRow) -> tuple:
    """What must be the same both ways; actions differ by float rounding where batches differ."""
    return row.outcome, row.steps


def main() -> None:
    """Measures, and prints a line of JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--env", default="roborecover_metaworld", choices=sorted(WIDTHS))
    parser.add_argument("--scenarios", type=int, default=4)
    parser.add_argument("--trials", type=int, default=3)
    parser.add_argument("--horizon", type=int, default=60, help="steps a trial may take")
    parser.add_argument("--size", type=int, default=128, help="side of the pictures, pixels")
    parser.add_argument("--actions", type=int, default=10, help="executed per inference")
    parser.add_argument("--slots", type=int, default=os.cpu_count())
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--work", type=Path, help="folder that keeps what has ended, to go on with")
    args = parser.parse_args()
    chosen = load_scenarios(f"{args.env.removeprefix('roborecover_')}_starter")
    if len(chosen) < args.scenarios:
        parser.error(f"the shipped set has {len(chosen)} scenarios, not {args.scenarios}")
    chosen = [chosen[i * len(chosen) // args.scenarios] for i in range(args.scenarios)]
    chosen = [replace(s, task=replace(s.task, horizon=args.horizon)) for s in chosen]
    sizes = {k: v for k, v in vars(args).items() if k not in ("repeat", "work")}
    with tempfile.TemporaryDirectory() as name:
        folder = args.work or Path(name)
        folder.mkdir(parents=True, exist_ok=True)
        if (folder / "sizes.json").exists() and json.loads((folder / "sizes.json").read_text()) != sizes:
            parser.error(f"--work {folder} holds runs of other sizes; use another folder")
        policy, root = folder / "policy", folder / "set"
        if not (folder / "sizes.json").exists():
            save_policy(policy, args.env, args.size, args.actions)
            write_scenarios(root, chosen)
            (folder / "sizes.json").write_text(json.dumps(sizes))
        common = [
            f"--env.type={args.env}", f"--env.scenarios={root}", f"--policy.path={policy}",
            "--policy.device=cpu", f"--eval.n_episodes={args.trials}",
            f"--env.observation_height={args.size}", f"--env.observation_width={args.size}",
        ]  # fmt: skip
        bin_folder = Path(sys.executable).parent
        ratios, seconds = [], []
        for k in range(args.repeat):
            plain = [str(bin_folder / "lerobot-eval"), *common, f"--eval.batch_size={args.trials}"]
            fast = [str(bin_folder / "roborecover"), "eval", *common, f"--runner.slots={args.slots}"]
            results = []
            for side, command in (("plain", plain), ("fast", fast)):
                out = folder / f"{side}{k}"
                results.append(timed([*command, f"--output_dir={out}"], out))
            if results[0][1] != results[1][1]:
                sys.exit("the two ways gave different outcomes: no comparison")
            seconds.append([r[0] for r in results])
            ratios.append(seconds[-1][0] / seconds[-1][1])
            loads = ", ".join(f"{r[2]:.1f}" for r in results)
            plain_s, fast_s = seconds[-1]
            print(f"plain {plain_s:.1f} s, fast {fast_s:.1f} s, {ratios[-1]:.2f}x, loads {loads}", flush=True)
    plain_s, fast_s = (statistics.median(side) for side in zip(*seconds, strict=True))
    print(
        f"median of {len(ratios)}: plain {plain_s:.1f} s, fast {fast_s:.1f} s, ratio "
        f"{statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})"
    )
    print(json.dumps({"ratio": statistics.median(ratios), "seconds": seconds}))


if __name__ == "__main__":
    main()
