"""`roborecover detect data`."""

from __future__ import annotations

from lerobot_roborecover.detection.data.request import MonitorRequest, make_monitor_data

HELP = (
    "Make the frames that a monitor is trained and measured on: screening policies continue each scenario "
    "once; label 0 before the recovery point, 1 from it on; split by scenario."
)

OPTIONS = MonitorRequest


def run(options: MonitorRequest) -> int:
    """Makes the data and prints the counts."""
    import datasets

    from lerobot_roborecover.detection.data.choice import TRAIN
    from lerobot_roborecover.utils.progress import Progress
    from lerobot_roborecover.utils.text import align

    datasets.disable_progress_bars()  # LeRobot's writer shows one per episode
    made = make_monitor_data(options, Progress("frame").of)
    columns = {
        "ids": "IDs",
        "trajectories": "traj.",
        "frames": "frames",
        "label0": "label 0",
        "label1": "label 1",
    }
    rows = [[part, *(c[name] for name in columns)] for part, c in made.counts.items()]
    print("\n".join(align([["", *columns.values()], *rows])))
    for reason, n in made.dropped.most_common():
        print(f"left out {n}: {reason}")
    if TRAIN in made.counts:
        config = "policies/train/monitor_small.yaml"
        print(f"\nlerobot-train --config_path={config} --dataset.root={options.out / TRAIN}")
    return 0
