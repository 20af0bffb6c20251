"""Writes the files of `examples/lerobot_benchmark` that are made from data; no trial is run.

    python -m recipes.lerobot_benchmark [--out examples/lerobot_benchmark]

- `datasets/SET/eval.yaml`: registers a set as a benchmark, as `roborecover dataset publish` does.
- `envhub/`: an EnvHub repository, as `roborecover dataset envhub` writes it.
- `models/POLICY/.eval_results/`: results of the studies' policies, from their stored outcomes.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

import yaml

from lerobot_roborecover.analysis.hub_results import find_entry, results_yaml
from lerobot_roborecover.analysis.leaderboard import make_leaderboard
from lerobot_roborecover.analysis.options import Options
from lerobot_roborecover.datasets import load_scenarios
from lerobot_roborecover.datasets.benchmark import EVAL_FILE, eval_yaml, split_names
from lerobot_roborecover.evaluation.envhub import write_envhub
from lerobot_roborecover.utils.atomic_io import atomic_write
from recipes.study.definition import IN_CHECKOUT, StudyDefinition, read_definition
from recipes.study.stored import write_stored_logs

OUT = Path("examples/lerobot_benchmark")
SETS = ("metaworld_recovery", "libero_recovery")
STUDIES = ("metaworld_recovery", "libero")
OWNER = "ORG"
"""Stands for the organisation that publishes the sets."""
ENVHUB_SET = "metaworld_recovery"
"""Meta-World needs nothing that is not on PyPI."""


def write_files(out: Path) -> None:
    """Writes what needs no statistics: `eval.yaml` of each set, and the EnvHub repository."""
    for dataset in SETS:
        scenarios = list(load_scenarios(dataset))
        text = eval_yaml(dataset, scenarios[0].platform, len(scenarios), split_names(scenarios))
        atomic_write(out / "datasets" / dataset / EVAL_FILE, text)
    offered = load_scenarios(ENVHUB_SET, split="test")
    write_envhub(offered, out / "envhub", f"{OWNER}/{ENVHUB_SET}-env", "test")


def write_results(out: Path, options: Options | None = None) -> None:
    """Writes the result files of every policy of the studies; an intervention is no policy alone.

    Args:
        out: folder that holds `models`.
        options: of the leaderboard.
    """
    for name in STUDIES:
        study = read_definition(IN_CHECKOUT / name)
        with TemporaryDirectory() as folder:
            write_stored_logs(study, Path(folder))
            board = make_leaderboard(Path(folder), options)
        for policy in study.policies:
            place, entry = find_entry(board, policy)
            found = yaml.safe_load(results_yaml(place, entry, f"{OWNER}/{study.dataset}"))
            file = result_file(out, study, policy)
            atomic_write(file, yaml.safe_dump([_as_stored(one, study, policy) for one in found], width=110))


def result_file(out: Path, study: StudyDefinition, policy: str) -> Path:
    """Where a policy's results are: in its repository on the Hub, below `.eval_results`."""
    name = f"roborecover-{study.dataset.replace('_', '-')}.yaml"
    return out / "models" / f"{study.platform}_{policy}" / ".eval_results" / name


def _as_stored(result: dict, study: StudyDefinition, policy: str) -> dict:
    """A result that says where it is from: stored outcomes have no date, no log and no versions."""
    measured = result["notes"].split("; policy ")[0]
    said = f"policy {policy}, which reads simulator state; {measured}; stored outcomes of {study.root}"
    return {"dataset": result["dataset"], "value": result["value"], "notes": said}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Write the files of examples/lerobot_benchmark.")
    parser.add_argument("--out", type=Path, default=OUT)
    where = parser.parse_args().out
    write_files(where)
    write_results(where)
