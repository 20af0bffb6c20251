"""Loads every run's policy once, in one process: `python -m recipes.study.startable RUN.yaml`.

An arm that cannot start is found before the first trial of any, and not when its turn comes after hours.
"""

import sys
from collections.abc import Sequence

from lerobot_roborecover.evaluation.arms import CANNOT_START
from lerobot_roborecover.evaluation.loading import load_host
from lerobot_roborecover.evaluation.runner import RecoveryEvalConfig, host_spec
from lerobot_roborecover.policies.command_line import run_with_arguments


def _load(cfg: RecoveryEvalConfig) -> int:
    cfg.runner.check()
    load_host(host_spec(cfg))
    return 0


def main(argv: Sequence[str]) -> int:
    """Loads what each file's run would load, its composite policies checked against their environment.

    Args:
        argv: configurations, as `--config_path` of `roborecover eval` reads them.

    Returns:
        1 where one cannot be loaded; all of them are tried, and said.
    """
    status = 0
    for path in argv:
        try:
            run_with_arguments(_load, "roborecover-eval", [f"--config_path={path}"])
        except (Exception, SystemExit) as err:  # those of loaders and their libraries have nothing in common
            print(f"{CANNOT_START}{path}: {' '.join(str(err).split()) or type(err).__name__}", flush=True)
            status = 1
    return status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
