"""`examples/lerobot_benchmark`: its commands exist; its numbers are those of data and documentation."""

from __future__ import annotations

import csv
import json
import re
import subprocess
from collections import defaultdict
from functools import cache

import pytest
import yaml

from lerobot_roborecover._version import __version__
from lerobot_roborecover.cli.tree import find_call
from lerobot_roborecover.datasets import load_scenarios
from lerobot_roborecover.datasets.benchmark import FRAMEWORK, TASKS
from lerobot_roborecover.scenario import Outcome
from recipes import lerobot_benchmark
from recipes.study.definition import IN_CHECKOUT, read_definition
from tests.support.doc_blocks import ROOT, blocks_of, commands

FOLDER = ROOT / "examples" / "lerobot_benchmark"
PAGE = FOLDER / "roborecover.mdx"
OPTIONS = json.loads((ROOT / "tests" / "cli" / "options.json").read_text())
LEROBOTS = {
    "--policy.path", "--policy.device", "--eval.n_episodes", "--eval.batch_size", "--output_dir",
    "--env.type", "--env.obs_type",
}  # fmt: skip
"""LeRobot's own options that are used here."""


load = cache(load_scenarios)


def shell():
    for block in blocks_of(PAGE):
        if block.language == "bash":
            yield block.code
    job = yaml.safe_load((FOLDER / "benchmark_tests.yml").read_text())["jobs"]["roborecover-integration-test"]
    for step in job["steps"]:
        yield step.get("run", "").replace("bash -c '", "\n").replace("eval-artifacts'", "eval-artifacts")


@pytest.mark.nightly
@pytest.mark.slow
def test_every_evaluation_is_one():
    found = [words for code in shell() for words in commands(code, "lerobot-eval")]
    found += [words[1:] for code in shell() for words in commands(code, "roborecover") if words[0] == "eval"]
    assert len(found) == 7
    for words in found:
        given = dict(word.split("=", 1) for word in words)
        kind = given["--env.type"]
        ours = {*OPTIONS["lerobots"]["eval"], *OPTIONS["lerobots"][f"--env.type={kind}"]}
        assert set(given) <= ours | LEROBOTS
        platform = kind.removeprefix("roborecover_")
        chosen = load(
            given["--env.scenarios"], split=given.get("--env.split"), select=given.get("--env.select", "")
        )
        assert chosen.platform == platform
        path = given["--policy.path"]
        assert path in ("CHECKPOINT", "$POLICY") or (ROOT / path / "config.json").is_file()


def test_our_commands_exist():
    for code in shell():
        for words in commands(code, "roborecover"):
            call = find_call(words)
            assert call is not None, words
            assert not call.note, words


def rows(text):
    """Cells of every row of a page's tables, without the width that a formatter gives them."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    return [tuple(cell.strip() for cell in line.strip("|").split(" | ")) for line in lines]


@pytest.mark.slow
def test_the_task_table_counts_the_scenarios():
    counted = defaultdict(set)
    for name in ("libero_recovery", "metaworld_recovery"):
        found = load(name, split="test")
        for suite in {s.task.suite for s in found}:
            part = [s for s in found if s.task.suite == suite]
            (horizon,) = {s.task.horizon for s in part}
            counted[name].add((suite, len(part), len({s.task.name for s in part}), horizon))
    told = defaultdict(set)
    for kind, name, suite, *numbers in [r for r in rows(PAGE.read_text()) if len(r) == 6][2:]:
        assert kind.strip("`") == f"roborecover_{name.strip('`').split('_')[0]}"
        told[name.strip("`")].add((suite.strip("`"), *map(int, numbers)))
    assert told == counted


@pytest.mark.parametrize("study", lerobot_benchmark.STUDIES)
def test_the_results_are_those_of_the_studies(study):
    """The page's rows stand in the study's page; result files say what the stored outcomes give."""
    root = read_definition(IN_CHECKOUT / study)
    page = (ROOT / "docs" / "studies" / f"{study}.md").read_text()
    named = {}
    for row in rows(page):
        if row[0].strip("`") in root.policies:
            named.setdefault(row[0].strip("`"), row)  # the first table; later ones are of pairs and cells
    counted = len(load(root.scenarios, split="test"))
    _, _, table = PAGE.read_text().partition(f", {counted} scenarios ")
    told = rows(f"|{table.partition(chr(10) * 2)[0]}")[2:]
    assert [row[:4] for row in named.values()] == told
    assert set(named) == set(root.policies)
    solved = defaultdict(lambda: defaultdict(list))
    with open(ROOT / root.outcomes, newline="") as file:
        for row in csv.DictReader(file):
            solved[row["arm"]][row["scenario_id"]].append(row["outcome"] == Outcome.SUCCESS)
    for policy in root.policies:
        trials = solved[f"{policy}/recovery"].values()
        rate = 100 * sum(sum(found) / len(found) for found in trials) / len(trials)
        file = lerobot_benchmark.result_file(FOLDER, root, policy)
        values = {one["dataset"]["task_id"]: one["value"] for one in yaml.safe_load(file.read_text())}
        assert values["recovery_success_rate"] == pytest.approx(rate, abs=0.005)
        assert set(values) == set(TASKS)
        row = named[policy]
        rounded = 0.0501  # of one digit, from values of two
        assert float(row[3].split()[0]) == pytest.approx(values["recovery_success_rate"], abs=rounded)
        assert float(row[2].split()[0]) == pytest.approx(values["initial_state_success_rate"], abs=rounded)


@pytest.mark.slow
def test_files_made_from_data_are_those_of_today(tmp_path, monkeypatch):
    monkeypatch.chdir(ROOT)
    lerobot_benchmark.write_files(tmp_path)
    made = {path.relative_to(tmp_path): path.read_text() for path in tmp_path.rglob("*") if path.is_file()}
    assert len(made) == 5
    assert made == {name: (FOLDER / name).read_text() for name in made}


@pytest.mark.slow
@pytest.mark.nightly
def test_result_files_are_those_of_today(tmp_path, monkeypatch):
    monkeypatch.chdir(ROOT)
    lerobot_benchmark.write_results(tmp_path)
    made = {path.relative_to(tmp_path): path.read_text() for path in tmp_path.rglob("*.yaml")}
    assert made == {name: (FOLDER / name).read_text() for name in made}


@pytest.mark.lerobot
def test_the_observations_are_those_of_the_env_types():
    import draccus

    from lerobot_roborecover.evaluation.env_configs import env_type

    told = rows(PAGE.read_text())
    for platform in ("libero", "metaworld"):
        config = draccus.decode(env_type(platform), {"scenarios": f"{platform}_recovery"})
        for key, feature in config.features.items():
            name, shape = config.features_map.get(key, key), str(tuple(feature.shape))
            kind = f"`roborecover_{platform}`"
            found = [row for row in told if row[0] == kind and (f"`{name}`" in row[1] or name == "action")]
            assert any(shape in row for row in found), (name, shape)
        assert any(f"at {config.fps} Hz" in row[-1] for row in told if row[0] == kind)


def test_the_page_has_what_their_template_asks_for():
    text = PAGE.read_text()
    headings = [
        "# RoboRecover", "## Available tasks", "## Installation", "## Evaluation",
        "### Recommended evaluation episodes", "## Policy inputs and outputs", "## Training",
        "## Reproducing published results",
    ]  # fmt: skip
    places = [text.index(f"{heading}\n") for heading in headings]
    assert places == sorted(places)
    counts = [len(load(name, split="test")) for name in ("libero_recovery", "metaworld_recovery")]
    libero, metaworld = (f"{5 * count:,}" for count in counts)
    assert f"as in the paper: {libero} trials on LIBERO, {metaworld} on Meta-World" in text
    readme = (FOLDER / "README.md").read_text()
    assert f"lerobot_env_roborecover[libero]=={__version__} ;" in readme
    assert f"{FRAMEWORK}: {{" in readme
    for name in re.findall(r"`((?:docs|docker|tests)/[\w./]+\.\w+)`", readme):
        assert (ROOT / name).exists() or name.startswith("docs/source/"), name


def test_the_job_takes_nothing_unpinned():
    job = yaml.safe_load((FOLDER / "benchmark_tests.yml").read_text())["jobs"]["roborecover-integration-test"]
    for step in job["steps"]:
        if "uses" in step:
            assert re.fullmatch(r"[\w.-]+/[\w.-]+@[0-9a-f]{40}", step["uses"])
        if "run" in step:
            subprocess.run(["bash", "-n"], input=step["run"], text=True, check=True)
    assert "@sha256:" in (FOLDER / "Dockerfile.benchmark.roborecover").read_text()
