"""RSR against latency, from trial logs: a table, and a figure as SVG and PNG.

    for latency in 0 0.1 0.2 0.4; do
        roborecover eval --env roborecover_libero --policy.path=CHECKPOINT --eval.n_episodes=5 \\
            --env.realtime=true --env.latency_s=$latency --env.trial_log=latency.jsonl
    done
    python benchmarks/latency.py latency.jsonl --out latency

One log may hold all latencies: a trial's settings are part of its identity.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from lerobot_roborecover.analysis.figures.latency import latency_figure
from lerobot_roborecover.analysis.figures.style import png_of, svg_of
from lerobot_roborecover.analysis.latency import latency_rates, latency_table
from lerobot_roborecover.analysis.tables import to_csv, to_text
from lerobot_roborecover.logs.trial_log import read_trial_log
from lerobot_roborecover.utils.atomic_io import atomic_write


def main(argv: list[str] | None = None) -> None:
    """Prints the table and writes table and figure."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("logs", nargs="+", type=Path, metavar="LOG")
    parser.add_argument("--out", type=Path, default=Path("latency"), metavar="DIR")
    args = parser.parse_args(argv)
    rates = latency_rates(row for log in args.logs for row in read_trial_log(log))
    table, figure = latency_table(rates), latency_figure(rates)
    print(to_text(table))
    atomic_write(args.out / "latency.csv", to_csv(table))
    atomic_write(args.out / "latency.svg", svg_of(figure.plot))
    atomic_write(args.out / "latency.png", png_of(figure.plot))
    print(f"figure    {args.out / 'latency.svg'}")


if __name__ == "__main__":
    main()
