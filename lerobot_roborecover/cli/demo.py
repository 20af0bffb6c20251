"""`roborecover demo`."""

from __future__ import annotations

from lerobot_roborecover.demo.settings import DemoSettings

HELP = (
    "Evaluate the shipped policy on the shipped Meta-World scenarios with lerobot-eval, from recovery and "
    "from initial starts; print the table and write a page of pictures."
)

OPTIONS = DemoSettings


def run(options: DemoSettings) -> int:
    from lerobot_roborecover.demo.run import run_demo

    run_demo(options)
    return 0
